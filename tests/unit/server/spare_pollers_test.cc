#include "server/spare_pollers.h"

#include <grpcpp/grpcpp.h>
#include <gtest/gtest.h>
#include <sched.h>

#include <memory>
#include <set>
#include <thread>

#include "absl/synchronization/blocking_counter.h"
#include "absl/synchronization/mutex.h"
#include "spikeserve/v1/policy_service.grpc.pb.h"

namespace spikeserve {
namespace {

// Binds the thread to one of its processors.
class OnOneProcessor {
 public:
  OnOneProcessor() {
    sched_getaffinity(0, sizeof(before_), &before_);
    int first = 0;
    while (!CPU_ISSET(first, &before_)) ++first;
    cpu_set_t one;
    CPU_ZERO(&one);
    CPU_SET(first, &one);
    sched_setaffinity(0, sizeof(one), &one);
  }
  ~OnOneProcessor() { sched_setaffinity(0, sizeof(before_), &before_); }

 private:
  cpu_set_t before_;
};

// The threads on which gRPC ran the callbacks of many calls.
std::set<std::thread::id> CallbackThreads() {
  constexpr int kCalls = 200;
  const auto stub = v1::PolicyService::NewStub(grpc::CreateChannel("", nullptr));
  struct Call {
    grpc::ClientContext context;
    v1::ListPoliciesRequest request;
    v1::ListPoliciesResponse response;
  };
  absl::Mutex mutex;
  std::set<std::thread::id> threads;
  absl::BlockingCounter answered(kCalls);
  for (int i = 0; i < kCalls; ++i) {
    auto call = std::make_shared<Call>();
    stub->async()->ListPolicies(&call->context, &call->request, &call->response,
                                [&, call](const grpc::Status&) {
                                  {
                                    absl::MutexLock lock(&mutex);
                                    threads.insert(std::this_thread::get_id());
                                  }
                                  std::this_thread::yield();  // to any other one
                                  answered.DecrementCount();
                                });
  }
  answered.Wait();
  return threads;
}

TEST(SparePollersTest, OneProcessorNeedsOneThread) {
  const OnOneProcessor here;
  ASSERT_GE(CountSparePollers(), 1);  // gRPC runs two at least
  const SparePollers spare(CountSparePollers());
  EXPECT_EQ(CallbackThreads().size(), 1u);
}

TEST(SparePollersTest, ParkedThreadsComeBack) {
  const OnOneProcessor here;
  for (int i = 0; i < 3; ++i) const SparePollers spare(CountSparePollers());
  EXPECT_GE(CallbackThreads().size(), 1u);
}

}  // namespace
}  // namespace spikeserve
