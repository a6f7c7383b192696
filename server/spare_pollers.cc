#include "server/spare_pollers.h"

#include <grpc/support/cpu.h>
#include <grpcpp/client_context.h>
#include <grpcpp/create_channel.h>
#include <grpcpp/generic/generic_stub.h>
#include <grpcpp/version_info.h>
#include <sched.h>

#include <algorithm>

#include "absl/synchronization/blocking_counter.h"

namespace spikeserve {
namespace {

// Processors this process may run on; 0 where that is not known.
int AllowedProcessors() {
  cpu_set_t allowed;
  return sched_getaffinity(0, sizeof(allowed), &allowed) == 0 ? CPU_COUNT(&allowed) : 0;
}

// A call that goes nowhere: its callback runs at once, on one of gRPC's threads, which are the same
// for clients and servers.
struct IdleCall {
  grpc::ClientContext context;
  grpc::Slice nothing;
  grpc::ByteBuffer request = grpc::ByteBuffer(&nothing, 1);
  grpc::ByteBuffer response;
};

}  // namespace

int CountSparePollers() {
  if (GRPC_CPP_VERSION_MAJOR != 1 || GRPC_CPP_VERSION_MINOR != 51) return 0;
  const int allowed = AllowedProcessors();
  if (allowed == 0) return 0;
  const int pollers = std::clamp(static_cast<int>(gpr_cpu_num_cores()) / 2, 2, 16);
  return std::max(0, pollers - allowed);
}

// Without credentials every call on the channel fails before it has begun.
SparePollers::SparePollers(int count)
    : released_(std::make_shared<absl::Notification>()),
      channel_(grpc::CreateChannel("", nullptr)) {
  absl::BlockingCounter parked(count);
  grpc::GenericStub stub(channel_);
  for (int i = 0; i < count; ++i) {
    auto call = std::make_shared<IdleCall>();
    stub.UnaryCall(&call->context, "", grpc::StubOptions(), &call->request, &call->response,
                   [call, &parked, released = released_](const grpc::Status&) {
                     parked.DecrementCount();
                     released->WaitForNotification();
                   });
  }
  parked.Wait();
}

}  // namespace spikeserve
