// Makes the hand-over of data between gRPC's threads visible to the thread sanitizer.
//
// Debian's gRPC is built without the sanitizer, and its queues are lock-free, so that a call that
// is started on one thread and completed on another would be reported as a race. The definitions
// below replace those of the library, like those in tsan_absl.cc, and report an order that gRPC
// guarantees. Nothing is suppressed: a race in this project's code is still reported when gRPC
// calls that code.
//
// Linked into the programs of the `tsan` preset only.
#include <dlfcn.h>
#include <grpc/grpc.h>
#include <grpcpp/support/server_callback.h>

extern "C" void __tsan_acquire(void* address);
extern "C" void __tsan_release(void* address);

// Starts an operation and releases its tag: the operation completes after it was started.
extern "C" grpc_call_error grpc_call_start_batch(grpc_call* call, const grpc_op* ops, size_t count,
                                                 void* tag, void* reserved) {
  static const auto next =
      reinterpret_cast<decltype(&grpc_call_start_batch)>(dlsym(RTLD_NEXT, "grpc_call_start_batch"));
  __tsan_release(tag);
  return next(call, ops, count, tag, reserved);
}

// Returns a completed operation to the thread that runs its callback, and acquires its tag.
extern "C" grpc_event grpc_completion_queue_next(grpc_completion_queue* queue,
                                                 gpr_timespec deadline, void* reserved) {
  static const auto next = reinterpret_cast<decltype(&grpc_completion_queue_next)>(
      dlsym(RTLD_NEXT, "grpc_completion_queue_next"));
  const grpc_event event = next(queue, deadline, reserved);
  if (event.type == GRPC_OP_COMPLETE) __tsan_acquire(event.tag);
  return event;
}

namespace grpc::internal {

// OnDone runs after all references to the call are released. When a call is cancelled, the last
// reference is released inside the library, where the sanitizer does not see it. The others are
// released in inline functions of headers, which are instrumented.
void ServerCallbackCall::ScheduleOnDone(bool inline_ondone) {
  static const auto next = reinterpret_cast<void (*)(ServerCallbackCall*, bool)>(
      dlsym(RTLD_NEXT, "_ZN4grpc8internal18ServerCallbackCall14ScheduleOnDoneEb"));
  __tsan_acquire(&callbacks_outstanding_);
  next(this, inline_ondone);
}

}  // namespace grpc::internal
