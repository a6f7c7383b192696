#include "server/services/loop_services.h"

#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

// Finishes a call of a method that the server does not have.
class UnknownCall final : public CallHandler {
 public:
  explicit UnknownCall(Call* call) {
    call->Finish(absl::UnimplementedError(
        absl::StrCat("method: expected one that this server has, received ", call->head().path)));
  }
  size_t message_limit() const override { return 0; }
  void OnMessage(absl::string_view /*message*/) override {}
  void OnTooLong(size_t /*length*/) override {}
  void OnHalfClose() override {}
  void OnClosed() override {}
  void OnDrain() override {}
};

}  // namespace

void LoopServices::Attach(const std::vector<std::unique_ptr<LoopServices>>& all) {
  std::vector<ActQueue*> queues;
  for (const auto& services : all) queues.push_back(&services->acts_);
  acts_.SetQueues(std::move(queues));
  loop_.SetRouter(this);
  loop_.AtEndOfTurn([this] {
    acts_.Run();
    loop_.FlushWrites();
    deferred_.Run();
  });
}

std::shared_ptr<CallHandler> LoopServices::Route(Call* call) {
  const ServiceTable::Open* open = table_.Find(call->head().path);
  if (open == nullptr) return std::make_shared<UnknownCall>(call);
  return (*open)(call, this);
}

}  // namespace spikeserve
