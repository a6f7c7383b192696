#include "client/src/pilot/datagram_link.h"

#include <netdb.h>
#include <poll.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <array>
#include <cstring>
#include <utility>

#include "absl/strings/str_cat.h"

namespace spikeserve::piloting {
namespace {

constexpr size_t kNumberBytes = 8;
constexpr int kTryAgain = 1000;  // milliseconds, to find a server whose name was not found

std::string NumberText(uint64_t number) {
  std::string text(kNumberBytes, '\0');
  for (size_t i = kNumberBytes; i-- > 0; number >>= 8) text[i] = static_cast<char>(number & 0xff);
  return text;
}
uint64_t NumberOf(absl::string_view text) {
  uint64_t number = 0;
  for (const char byte : text.substr(0, kNumberBytes)) {
    number = number << 8 | static_cast<unsigned char>(byte);
  }
  return number;
}

}  // namespace

DatagramLink::Descriptor::~Descriptor() {
  if (fd >= 0) close(fd);
}

int DatagramLink::MakeWakeup() { return eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK); }

void DatagramLink::Stop() {
  std::thread thread;
  {
    absl::MutexLock lock(&mutex_);
    is_stopping_ = true;
    thread = std::move(thread_);
  }
  if (!thread.joinable()) return;
  eventfd_write(wakeup_.fd, 1);
  thread.join();
}

absl::Status DatagramLink::SetChannel(const v1::DatagramChannel& channel) {
  auto sealed = SealedChannel::Create(channel.key_id(), channel.key(), SealedChannel::End::kRobot);
  if (!sealed.ok()) return sealed.status();
  if (channel.endpoint().rfind(':') == std::string::npos) {
    return absl::InvalidArgumentError(
        absl::StrCat("datagrams.endpoint: expected HOST:PORT, received ", channel.endpoint()));
  }
  absl::MutexLock lock(&mutex_);
  if (is_stopping_) return absl::OkStatus();
  former_ = std::exchange(channel_, *std::move(sealed));
  if (std::exchange(endpoint_, channel.endpoint()) != channel.endpoint()) socket_ = nullptr;
  if (!thread_.joinable()) {
    thread_ = std::thread([this] { Run(); });
  } else {
    eventfd_write(wakeup_.fd, 1);
  }
  return absl::OkStatus();
}

void DatagramLink::Send(uint64_t number, const v1::ActRequest& request, int copies) {
  const std::string payload = absl::StrCat(NumberText(number), request.SerializeAsString());
  absl::MutexLock lock(&mutex_);
  if (socket_ == nullptr || is_stopping_) return;
  std::string datagram;
  for (int i = 0; i < copies && channel_->Seal(payload, &datagram); ++i) {
    sendto(socket_->fd, datagram.data(), datagram.size(), MSG_DONTWAIT | MSG_NOSIGNAL,
           reinterpret_cast<const sockaddr*>(&address_), address_size_);
  }
}

void DatagramLink::Run() {
  std::array<char, kDatagramBytes + 1> buffer;  // one that is longer is cut off, and refused
  while (true) {
    const std::shared_ptr<Descriptor> socket = FindServer();
    std::array<pollfd, 2> ready = {
        {{.fd = wakeup_.fd, .events = POLLIN, .revents = 0},
         {.fd = socket == nullptr ? -1 : socket->fd, .events = POLLIN, .revents = 0}}};
    poll(ready.data(), ready.size(), socket == nullptr ? kTryAgain : -1);
    eventfd_t count = 0;
    if (ready[0].revents != 0) eventfd_read(wakeup_.fd, &count);
    {
      absl::MutexLock lock(&mutex_);
      if (is_stopping_) return;
    }
    if (ready[1].revents == 0) continue;
    const ssize_t size = recv(socket->fd, buffer.data(), buffer.size(), MSG_DONTWAIT);
    if (size > 0) Receive({buffer.data(), static_cast<size_t>(size)});
  }
}

std::shared_ptr<DatagramLink::Descriptor> DatagramLink::FindServer() {
  std::string endpoint;
  {
    absl::MutexLock lock(&mutex_);
    if (socket_ != nullptr || is_stopping_) return socket_;
    endpoint = endpoint_;
  }
  const size_t colon = endpoint.rfind(':');
  std::string host = endpoint.substr(0, colon);
  if (host.size() > 2 && host.front() == '[') host = host.substr(1, host.size() - 2);
  addrinfo hints = {};
  hints.ai_socktype = SOCK_DGRAM;
  addrinfo* found = nullptr;
  if (getaddrinfo(host.c_str(), endpoint.c_str() + colon + 1, &hints, &found) != 0) return nullptr;
  auto opened = std::make_shared<Descriptor>(
      socket(found->ai_family, SOCK_DGRAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0));
  absl::MutexLock lock(&mutex_);
  if (opened->fd >= 0 && endpoint == endpoint_) {
    std::memcpy(&address_, found->ai_addr, found->ai_addrlen);
    address_size_ = found->ai_addrlen;
    socket_ = std::move(opened);
  }
  freeaddrinfo(found);
  return socket_;
}

void DatagramLink::Receive(absl::string_view datagram) {
  std::string payload;
  {
    absl::MutexLock lock(&mutex_);
    bool is_newest = false;
    const std::optional<uint64_t> id = KeyIdOf(datagram);
    SealedChannel* const channel =
        former_ != nullptr && id == former_->key_id() ? former_.get() : channel_.get();
    if (channel->Open(datagram, &payload, &is_newest) != Opened::kOk) return;
  }
  v1::ActResponse reply;
  if (payload.size() < kNumberBytes ||
      !reply.ParseFromArray(payload.data() + kNumberBytes,
                            static_cast<int>(payload.size() - kNumberBytes))) {
    return;
  }
  listener_->OnDatagram(NumberOf(payload), reply);
}

}  // namespace spikeserve::piloting
