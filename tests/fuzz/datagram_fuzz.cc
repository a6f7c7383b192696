// Datagrams from anywhere: only what the other end has sealed is opened, and that once.
#include "core/datagram/sealed_channel.h"
#include "tests/fuzz/fuzz_target.h"

namespace spikeserve {
namespace {

constexpr uint64_t kKeyId = 0x0102030405060708;

std::unique_ptr<SealedChannel> Channel(SealedChannel::End end, char key = 'k') {
  return *SealedChannel::Create(kKeyId, std::string(kDatagramKeyBytes, key), end);
}

}  // namespace

void FuzzOne(absl::string_view input) {
  const auto robot = Channel(SealedChannel::End::kRobot);
  const auto server = Channel(SealedChannel::End::kServer);
  std::string payload, datagram;
  bool is_newest = false;
  const auto open = [&](SealedChannel& channel, absl::string_view any) {
    return channel.Open(any, &payload, &is_newest);
  };
  FUZZ_CHECK(open(*Channel(SealedChannel::End::kServer, 'o'), input) != Opened::kOk);
  FUZZ_CHECK(open(*robot, input) != Opened::kOk);
  // Seeds have the key.
  if (open(*server, input) == Opened::kOk) FUZZ_CHECK(open(*server, input) == Opened::kReplayed);
  const auto fresh = Channel(SealedChannel::End::kServer);
  if (!robot->Seal(input, &datagram)) return;
  FUZZ_CHECK(open(*fresh, datagram) == Opened::kOk && payload == input);
  FUZZ_CHECK(open(*fresh, datagram) == Opened::kReplayed);
}

std::vector<std::string> Seeds() {
  std::string empty, filled;
  const auto robot = Channel(SealedChannel::End::kRobot);
  FUZZ_CHECK(robot->Seal("", &empty) && robot->Seal("step", &filled));
  return {empty, filled, filled.substr(0, kDatagramHeadBytes)};
}

}  // namespace spikeserve
