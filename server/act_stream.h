// One ActStream call.
#ifndef SERVER_ACT_STREAM_H_
#define SERVER_ACT_STREAM_H_

#include "core/session/clock.h"
#include "server/answer_stream.h"
#include "server/call_tracker.h"
#include "server/metrics.h"
#include "server/request_handler.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// What every call needs; all must outlive the call.
struct ServiceParts {
  const RequestHandler* handler;
  CallTracker* calls;
  Metrics* metrics;
  const Clock* clock;
};

// Thread-safe as AnswerStream is.
class ActStream final : public AnswerStream<v1::ActRequest, v1::ActResponse> {
 public:
  explicit ActStream(const ServiceParts& parts) : parts_(parts) {}

 protected:
  void Answer(const v1::ActRequest& request, v1::ActResponse* response,
              DeferredWork* deferred) override;

 private:
  const ServiceParts parts_;
};

}  // namespace spikeserve

#endif  // SERVER_ACT_STREAM_H_
