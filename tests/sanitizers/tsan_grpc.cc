// Lets the thread sanitizer see how gRPC hands what it was given from one thread to another.
//
// Debian's gRPC is built without the sanitizer, and its queues have no locks, so a call that is
// started on one thread and completed on another would look like a race. These definitions stand in
// front of the library's, as those of tsan_absl.cc do, and tell the sanitizer of an order that gRPC
// promises. Nothing is suppressed: a race of our own code is reported wherever gRPC called it.
// Linked into the programs of the `tsan` preset only.
#include <dlfcn.h>
#include <grpc/grpc.h>
#include <grpcpp/support/server_callback.h>

extern "C" void __tsan_acquire(void* address);
extern "C" void __tsan_release(void* address);

// An operation completes after it was started. Its tag goes in here ...
extern "C" grpc_call_error grpc_call_start_batch(grpc_call* call, const grpc_op* ops, size_t count,
                                                 void* tag, void* reserved) {
  static const auto next =
      reinterpret_cast<decltype(&grpc_call_start_batch)>(dlsym(RTLD_NEXT, "grpc_call_start_batch"));
  __tsan_release(tag);
  return next(call, ops, count, tag, reserved);
}

// ... and comes out here, on the thread that runs its callback.
extern "C" grpc_event grpc_completion_queue_next(grpc_completion_queue* queue,
                                                 gpr_timespec deadline, void* reserved) {
  static const auto next = reinterpret_cast<decltype(&grpc_completion_queue_next)>(
      dlsym(RTLD_NEXT, "grpc_completion_queue_next"));
  const grpc_event event = next(queue, deadline, reserved);
  if (event.type == GRPC_OP_COMPLETE) __tsan_acquire(event.tag);
  return event;
}

namespace grpc::internal {

// A call is done after all that referred to it. Where it was cancelled, the last reference is given
// back within the library, which the sanitizer does not see; the others are given back in headers.
void ServerCallbackCall::ScheduleOnDone(bool inline_ondone) {
  static const auto next = reinterpret_cast<void (*)(ServerCallbackCall*, bool)>(
      dlsym(RTLD_NEXT, "_ZN4grpc8internal18ServerCallbackCall14ScheduleOnDoneEb"));
  __tsan_acquire(&callbacks_outstanding_);
  next(this, inline_ondone);
}

}  // namespace grpc::internal
