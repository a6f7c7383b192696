// One HTTP/2 connection of a client: its socket, nghttp2's session, and its streams.
//
// Confined to the thread of its loop.
#pragma once

#include <nghttp2/nghttp2.h>

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "absl/container/flat_hash_map.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "server/transport/connection_table.h"
#include "server/transport/event_loop.h"
#include "server/transport/frame_budget.h"
#include "server/transport/frame_memory.h"
#include "server/transport/grpc_stream.h"
#include "server/transport/limits.h"
#include "server/transport/socket.h"
#include "server/transport/transport_budgets.h"
#include "server/transport/unauthenticated_queue.h"

namespace spikeserve {

class Connection final : public EventLoop::Source,
                         public UnauthenticatedQueue::Waiter,
                         public GrpcStream::Owner {
 public:
  // A connection only moves on to a later state, and may skip some.
  enum class State {
    kOpen,
    kGoingAway,  // has sent GOAWAY, and closes after the calls in progress
    kCondemned,  // has exceeded a limit; closes with ENHANCE_YOUR_CALM when nghttp2 returns
    kClosing,    // sends nothing more, and waits a short time for the client to close
    kClosed,     // is destroyed at the end of the turn
  };

  // What all connections of a loop share. Outlives them.
  struct Shared {
    EventLoop* loop;
    const Clock* clock;
    CallRouter* router;
    const TransportLimits* limits;
    TransportBudgets* budgets;
    std::function<void(Connection*)> closed;  // destroys the connection at the end of the turn
    UnauthenticatedQueue unauthenticated_queue;
    std::vector<Connection*> to_flush = {};     // have something to send at the end of the turn
    std::vector<Connection*> to_continue = {};  // have something to read in the next turn
  };

  // Starts HTTP/2. Call Start() next. REQUIRES: Close() is called before the destructor.
  Connection(std::unique_ptr<Socket> socket, std::unique_ptr<ConnectionSlot> slot, Shared* shared);
  ~Connection() override;

  // Watches the socket. Returns RESOURCE_EXHAUSTED if the system has no memory for that.
  absl::Status Start();

  // EventLoop::Source
  void OnReady(uint32_t events) override;

  // UnauthenticatedQueue::Waiter
  void OnTurn() override;

  // Reads what earlier turns of the loop have left.
  void Continue();
  // Sends what is ready to be sent, as far as the client takes it.
  void Flush();
  // Closes the connection if it has exceeded a time limit. To be called once every kCheckInterval.
  void CheckTimes();
  static constexpr absl::Duration kCheckInterval = absl::Seconds(1);
  // Tells the client to make no more calls here (GOAWAY) and lets those in progress finish.
  void GoAway();
  // Tells the handlers of all calls that the server stops.
  void Drain();
  // Closes the connection now; calls are cancelled.
  void Close();
  // As Close(), in favour of other connections. Tells the client to come back later, if it listens.
  void Drop();

  State state() const { return state_; }
  // Returns the connection's number in the table.
  uint64_t number() const { return slot_->number(); }

  // GrpcStream::Owner
  EventLoop& loop() override { return *shared_->loop; }
  Peer peer() const override {
    return {.address = slot_->address(), .certificate = socket_->peer_subject()};
  }
  CallRouter& router() override { return *shared_->router; }
  const TransportLimits& limits() const override { return *shared_->limits; }
  bool CountBytes(int64_t bytes) override;
  bool CountUnauthenticatedBytes(int64_t bytes) override;
  bool CountProcessBytes(int64_t bytes) override;
  void CountAnswers(int64_t bytes) override { answer_bytes_ += bytes; }
  void WantFlush() override;
  bool MayRead() const override;
  void MarkKnown(const std::shared_ptr<ByteBudget>& tenant) override;
  const std::shared_ptr<ByteBudget>& tenant() const override { return tenant_; }
  void ReadOnLater(int32_t id) override;

 private:
  // What every session of the process uses; lives as long as the process. The callbacks are the
  // methods from OnBeginHeaders() on.
  static const nghttp2_session_callbacks* Callbacks();
  static const nghttp2_option* SessionOption();

  struct FreeSession {
    void operator()(nghttp2_session* session) const { nghttp2_session_del(session); }
  };

  // Moves on to `next`, a later state.
  void Enter(State next);
  bool is_closing() const { return state_ >= State::kClosing; }
  bool is_closed() const { return state_ == State::kClosed; }
  // Reads what is there; an unauthenticated one may have to wait for its turn.
  void ReadWhenDue();
  void ReadAll();
  // Passes on what streams have stored, for as long as a step may take.
  void ReadStored();
  // Calls Continue() in the next turn.
  void ContinueLater();
  // Returns false if the connection was closed.
  bool Receive(absl::string_view data);
  // Asks a silent client for a sign of life. Returns false if it has not given one in time.
  bool KeepAlive();
  // Gives back the memory that an idle connection does not need.
  void ReleaseBuffers();
  // Appends frames of the session to `unsent_`, up to a limit.
  void Gather();
  // Sets which events the loop waits for.
  void UpdateWatch();
  // Sends what is ready, then closes in order: closing a socket with unread bytes would make the
  // system drop what the client has not read yet. Waits a short time for the client to close.
  void CloseInOrder();
  // Reads and drops what arrives while the connection closes.
  void DropInput();
  // Cancels all calls.
  void CloseStreams();
  // Counts what a unauthenticated connection occupies, apart from its streams; -1: no longer.
  void CountOverhead(int sign);
  // Sends GOAWAY with nghttp2's `error`, then closes in order.
  void Abort(uint32_t error);
  GrpcStream* FindStream(int32_t id);

  // Events of the session. They return 0 or one of nghttp2's errors.
  int OnBeginHeaders(int32_t id);
  int OnHeader(int32_t id, absl::string_view name, absl::string_view value);
  int OnFrame(const nghttp2_frame& frame);
  int OnDataChunk(int32_t id, absl::string_view data);
  int OnStreamClosed(int32_t id);
  int OnFrameSent(const nghttp2_frame& frame);
  int OnInvalidFrame();
  // Counts a frame that costs work and carries no request. Ends the connection if there are too
  // many; `limit` names the flag.
  int ChargeFrame(FrameBudget* budget, absl::string_view limit);
  // Ends the connection, which has exceeded a limit.
  int CloseOverLimit(absl::string_view limit);

  const std::unique_ptr<Socket> socket_;
  const std::unique_ptr<ConnectionSlot> slot_;
  Shared* const shared_;
  const absl::Duration connected_;                           // the loop's clock
  absl::Duration last_active_;                               // when a stream was opened or closed
  absl::Duration blocked_since_ = absl::InfiniteDuration();  // the client takes no bytes
  absl::Duration headers_since_ = absl::InfiniteDuration();  // a header block is incomplete
  FrameBudget resets_;
  FrameBudget control_frames_;
  int64_t bytes_ = 0;                   // that streams store
  int64_t answer_bytes_ = 0;            // those that are answers
  int64_t unauthenticated_bytes_ = 0;   // while unauthenticated
  std::shared_ptr<ByteBudget> tenant_;  // whose call was admitted last; null: unauthenticated
  FrameMemory frame_memory_;
  std::unique_ptr<nghttp2_session, FreeSession> session_;
  absl::flat_hash_map<int32_t, std::unique_ptr<GrpcStream>> streams_;
  std::vector<std::unique_ptr<GrpcStream>> closed_streams_;  // destroyed when no callback runs
  std::vector<int32_t> to_read_on_;
  std::string unsent_;  // frames, not yet written
  size_t written_ = 0;  // bytes of `unsent_` that were written
  bool has_buffers_ = true;
  bool waits_for_turn_ = false;  // in the unauthenticated queue
  uint32_t watched_ = 0;         // events
  State state_ = State::kOpen;
  absl::Duration closing_since_;  // when it entered kClosing, of the loop's clock
  size_t dropped_ = 0;            // bytes received since then
  int silent_checks_ = 0;         // calls of CheckTimes() since the last bytes of the client
  bool wants_flush_ = false;      // in Shared::to_flush
  bool continues_ = false;        // in Shared::to_continue
};

}  // namespace spikeserve
