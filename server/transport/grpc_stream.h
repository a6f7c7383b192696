// One gRPC call as an HTTP/2 stream: checks the request's headers, splits its data into messages,
// and frames the answer.
//
// Confined to the thread of its connection's loop.
#pragma once

#include <nghttp2/nghttp2.h>

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "server/transport/call.h"
#include "server/transport/limits.h"
#include "server/transport/message_reader.h"

namespace spikeserve {

class GrpcStream final : public Call {
 public:
  // The connection of a stream.
  class Owner {
   public:
    virtual ~Owner() = default;
    virtual EventLoop& loop() = 0;
    virtual Peer peer() const = 0;
    virtual CallRouter& router() = 0;
    virtual const TransportLimits& limits() const = 0;
    // Count bytes that the stream stores, or stores no longer if `bytes` is negative: of the
    // connection, of the process, and of unauthenticated clients. Return false if the limit is
    // exceeded; the bytes are counted in any case.
    virtual bool CountBytes(int64_t bytes) = 0;
    virtual bool CountProcessBytes(int64_t bytes) = 0;
    virtual bool CountUnauthenticatedBytes(int64_t bytes) = 0;
    // Counts those of these bytes that are answers.
    virtual void CountAnswers(int64_t bytes) = 0;
    // The connection has something to send at the end of the turn.
    virtual void WantFlush() = 0;
    // Returns false while the connection stores so many answers that its streams must not read on.
    virtual bool MayRead() const = 0;
    // A call was admitted: the client is authenticated.
    virtual void MarkKnown(const std::shared_ptr<ByteBudget>& tenant) = 0;
    // Returns the tenant whose call was admitted last; null: the client is unauthenticated.
    virtual const std::shared_ptr<ByteBudget>& tenant() const = 0;
    // Calls ReadOn() of stream `id`, if it still exists, once MayRead() returns true.
    virtual void ReadOnLater(int32_t id) = 0;
  };

  // What the client has sent of its request.
  enum class RequestState {
    kOpen,        // a part, perhaps
    kHalfClosed,  // all of it (END_STREAM), which the handler does not know yet
    kEnded,       // all of it, which the handler knows
  };
  // What was submitted to nghttp2 of the answer.
  enum class AnswerState {
    kNone,
    kSending,   // headers; nghttp2 takes the data with ReadAnswer()
    kWaiting,   // as kSending, but all data was sent, and nghttp2 waits to be resumed
    kFinished,  // the status ends the answer; nothing more can be added
    kClosed,    // OnClosed() was called
  };

  // `owner` and `session` must outlive the stream. REQUIRES: OnClosed() is called before the
  // destructor.
  GrpcStream(Owner* owner, nghttp2_session* session, int32_t id);
  ~GrpcStream() override;

  // Takes one header of the request. Returns false if the headers exceed the limits so far that
  // the connection should be closed.
  bool AddHeader(absl::string_view name, absl::string_view value);
  // The headers are complete: starts the call, or refuses it.
  void StartCall();
  // Takes data of the request.
  void OnData(absl::string_view data);
  // The client sends no more data.
  void OnHalfClose();
  // Passes on what was received while the client took no answers.
  void ReadOn();
  // The stream is closed. REQUIRES: it was not yet.
  void OnClosed();
  // The server stops.
  void OnDrain();
  // Counts what the stream stores as bytes of `tenant`.
  void CountFor(const std::shared_ptr<ByteBudget>& tenant);

  // Copies data of the answer to `out`, as nghttp2's data source. `flags` are nghttp2's.
  ssize_t ReadAnswer(uint8_t* out, size_t size, uint32_t* flags);

  RequestState request_state() const { return request_state_; }
  AnswerState answer_state() const { return answer_state_; }
  // Returns the time since which the client has taken nothing of an answer that is ready, of the
  // loop's clock; InfiniteDuration if none is.
  absl::Duration unsent_since() const { return unsent_since_; }
  // Returns the time since which a message is incomplete, of the loop's clock; InfiniteDuration
  // if none is.
  absl::Duration incomplete_since() const { return incomplete_since_; }

  // Call
  const CallHead& head() const override { return head_; }
  Peer peer() const override { return owner_->peer(); }
  EventLoop& loop() override { return owner_->loop(); }
  void Send(const google::protobuf::MessageLite& message) override;
  void SendFramed(std::string framed) override;
  void Finish(const absl::Status& status) override;
  void PauseReading() override { paused_ = true; }
  void ResumeReading() override;
  void Admit(std::shared_ptr<ByteBudget> tenant) override;
  void DropRequest() override { dropping_ = true; }
  bool Hold(int64_t bytes) override;

 private:
  // Passes complete messages to the handler while reading is not paused. Returns the rest.
  absl::string_view Deliver(absl::string_view data);
  void DeliverCompressed(absl::string_view message);
  // Lets the client send `bytes` more.
  void Consume(size_t bytes);
  // Counts what the stream stores. Returns false if a limit is exceeded.
  bool CountStored();
  // As CountStored(), but drops the part of a request that is stored, and refuses the call, if a
  // limit is exceeded.
  void BoundRequest();
  void RefuseForBytes();
  // Counts `bytes`, which the stream stores or, below 0, has freed, of its tenant or of
  // unauthenticated clients, and of the process. Returns false if one of these exceeds its limit.
  bool Count(int64_t bytes);
  // Frees the answers, which were sent completely.
  void FreeAnswers();
  bool reading() const {
    return !paused_ && !is_finished() && unsent() <= kUnsentLimit && owner_->MayRead();
  }
  bool is_finished() const { return answer_state_ >= AnswerState::kFinished; }
  size_t unsent() const { return answer_.size() - sent_; }

  // Counts and announces what was added to `answer_`.
  void SubmitAnswer();
  // Announces data to send.
  void SubmitData();
  void SubmitTrailersOnly(const absl::Status& status);
  // Answers what is no gRPC call with an HTTP status and a text, once the request is complete.
  void RefuseHttp(absl::string_view http_status, absl::string_view body);
  void SendHttpRefusal();
  // Submits headers, which the bytes of `answer_` follow.
  void SubmitWithData(const std::vector<nghttp2_nv>& headers);

  // A stream with more bytes of answers than this takes no further messages.
  static constexpr size_t kUnsentLimit = 64 << 10;

  Owner* const owner_;
  nghttp2_session* const session_;
  const int32_t id_;

  // Request.
  CallHead head_;
  std::string http_method_;
  std::string content_type_;
  std::string encoding_;
  std::string timeout_;
  int64_t header_bytes_ = 0;
  int64_t header_bytes_to_count_ = 0;  // when they reach this number, they are counted again
  int64_t headers_ = 0;
  std::shared_ptr<CallHandler> handler_;
  std::shared_ptr<ByteBudget> tenant_;  // null: unauthenticated
  bool within_group_ = true;            // what was counted last fits the limit of these
  int64_t held_ = 0;                    // bytes of the handler
  EventLoop::Timer deadline_timer_;
  MessageReader reader_;
  std::string unread_;  // received while reading was paused
  bool paused_ = false;
  bool dropping_ = false;
  bool delivering_ = false;
  RequestState request_state_ = RequestState::kOpen;
  absl::Duration incomplete_since_ = absl::InfiniteDuration();

  // Answer.
  std::string answer_;
  size_t sent_ = 0;  // bytes of `answer_` that were passed to nghttp2
  absl::Duration unsent_since_ = absl::InfiniteDuration();
  absl::Status status_;
  AnswerState answer_state_ = AnswerState::kNone;
  std::string http_refusal_;     // status, if an HTTP error is the answer
  int64_t counted_ = 0;          // bytes that were passed to Count()
  int64_t counted_here_ = 0;     // bytes that were passed to CountBytes()
  int64_t counted_answers_ = 0;  // bytes that were passed to CountAnswers()
};

}  // namespace spikeserve
