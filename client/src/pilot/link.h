// Brings the beats of a robot to the server, and the answers back.
//
// A background thread does everything that may take time, and never blocks for long itself. It
// looks at the state (is there a session, a stream, an episode that has ended?) and does the first
// thing that is missing, again and again, so that no event can be lost. The links of one client
// share this thread; a link with an engine on the robot, which computes, has one of its own.
//
//   lost        the session is given up: begin again with the beats that are kept
//   closing     the pilot was closed, and nothing is left to be sent, or its time is over: stop, on
//               the thread that closes
//   answered    a call of OpenSession, ExportSession or EndEpisode has ended: take its result
//   settled     the stream has answered the end of an episode: complete its future
//   broken      the stream has ended: remove it
//   queued      a beat waits for its request: send it
//   behind      the engine on the robot lacks beats: let it play one
//   no session  open one
//   no stream   open one, after a pause that grows to 0.2 s, at a server that has not denied the
//               session
//   no copy     bring the session to the engine on the robot
//   ended       the oldest episode has ended: send the beats of it that the server may miss and
//               its end, and the next episode may be asked for; if they are too many for one
//               request, send a part of them when no request is under way. A server of an earlier
//               release has no ends on streams: when it has all beats, call EndEpisode until it is
//               answered
//   silent      requests wait for answers: try a fresh connection, or another server
//   idle        wait until a fact changes
#ifndef CLIENT_SRC_PILOT_LINK_H_
#define CLIENT_SRC_PILOT_LINK_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "client/src/pilot/action_stream.h"
#include "client/src/pilot/background_thread.h"
#include "client/src/pilot/local_copy.h"
#include "client/src/pilot/server_call.h"
#include "client/src/pilot/shared_state.h"
#include "client/src/replicas.h"
#include "spikeserve/pilot_options.h"

namespace spikeserve::piloting {

// Returns the error of an episode whose end the server has not learned.
absl::Status LostEpisode(absl::string_view reason);

class Link : private ActionStream::Listener, private BackgroundThread::Worker {
 public:
  // `opening` has opened the session, with the answer `opened`, on `route`. `background` is that of
  // the client. The arguments must outlive the link.
  Link(Replicas* replicas, BackgroundThread* background, Route* route,
       v1::OpenSessionRequest opening, const v1::OpenSessionResponse& opened,
       const PilotOptions* options, SharedState* state);
  ~Link() override;

  // Lets the engine on the robot go on with an exported session. Only before Start. Errors: see
  // LocalPolicy::Resume.
  absl::Status Resume(const v1::ExportSessionResponse& exported) ABSL_LOCKS_EXCLUDED(state_->mutex);
  // Lets the background thread work.
  void Start();
  // Ends its work after the server has the ends of all episodes or `timeout` has passed, and closes
  // the session. Does nothing the second time.
  void Close(absl::Duration timeout) ABSL_LOCKS_EXCLUDED(state_->mutex);

 private:
  using Step = void (Link::*)();
  enum class Kind { kOpen, kExport, kEnd };

  std::optional<absl::Duration> Work() override ABSL_LOCKS_EXCLUDED(state_->mutex);
  // Returns what to do now, or null and until when to wait.
  Step Plan(absl::Duration now, absl::Duration* until) ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  Step PlanCalls(absl::Duration now, absl::Duration* until)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);

  // Steps, on the background thread and without the lock.
  void Lose() ABSL_LOCKS_EXCLUDED(state_->mutex);
  void Stop() ABSL_LOCKS_EXCLUDED(state_->mutex);
  void WriteLog() ABSL_LOCKS_EXCLUDED(state_->mutex);
  void TakeCall() ABSL_LOCKS_EXCLUDED(state_->mutex);
  void DropStream() ABSL_LOCKS_EXCLUDED(state_->mutex);
  void SendRequest() ABSL_LOCKS_EXCLUDED(state_->mutex);
  void CatchUp() ABSL_LOCKS_EXCLUDED(state_->mutex);
  void OpenSession();
  void OpenStream() ABSL_LOCKS_EXCLUDED(state_->mutex);
  void ExportSession() ABSL_LOCKS_EXCLUDED(state_->mutex);
  void EndEpisode() ABSL_LOCKS_EXCLUDED(state_->mutex);
  void CompleteSettled() ABSL_LOCKS_EXCLUDED(state_->mutex);

  // Returns whether a request for the oldest episode, which has ended, may be sent now.
  bool MaySendEnd(absl::Duration now) ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  // Replies, on threads of gRPC.
  void OnReply(const v1::ActResponse& reply) override ABSL_LOCKS_EXCLUDED(state_->mutex);
  void OnEnd(const absl::Status& status) override ABSL_LOCKS_EXCLUDED(state_->mutex);
  // Takes the reply to a request that ends the oldest episode.
  void TakeEnd(const v1::ActResponse& reply) ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  void TakeAnswer(const v1::ActResponse& reply, const SentRequest& request, absl::Duration now)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  void TakeError(const absl::Status& error, const SentRequest& request)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);

  // Makes the next call, which ends with call_done_.
  ServerCall& NewCall(Kind kind, absl::Duration timeout);
  void TakeOpened(const v1::OpenSessionResponse& opened)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  void CallFailed(Kind kind, const Replica* replica, const absl::Status& error)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  // Gives the engine on the robot up until the next export.
  void StopLocal() ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  // Stops using the stream, which the background thread removes.
  void EndStream() ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  // Tries a fresh connection, or another server, if requests wait for too long. Returns the time of
  // the next look.
  absl::Duration Doubt(absl::Duration now) ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  // Notes that the server of the stream has failed.
  void ReplicaFailed() ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  void PauseTries() ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  void Succeeded() ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  void Log(std::string line) ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  // Logs the first one of several failures.
  void LogFailure(const absl::Status& error) ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  // Notes that `replica` does not know the session. Returns whether the session may exist all the
  // same: a server that takes it over, or whose store has lost it, may deny it while another one
  // has it. A session that a store has is lost when those that answer have denied it for two
  // seconds.
  bool MayBeElsewhere(const Replica* replica) ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  // Gives the session up because of an error. A beat that the server has refused as not valid would
  // be refused again.
  void GiveUp(const absl::Status& error) ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);
  // Returns the ending of the oldest episode, whose end was answered by `summary`, which it
  // completes.
  Ending Settle(v1::EndEpisodeResponse* summary) ABSL_EXCLUSIVE_LOCKS_REQUIRED(state_->mutex);

  Replicas* const replicas_;
  Route* const route_;
  const PilotOptions& options_;
  SharedState* const state_;
  std::unique_ptr<BackgroundThread> own_background_;  // null: that of the client is used
  BackgroundThread* const background_;
  bool is_started_ = false;

  // Of the background thread, and after it of Close.
  v1::OpenSessionRequest opening_;  // has an id while it is under way
  LocalCopy local_;
  std::unique_ptr<ActionStream> stream_;
  std::unique_ptr<ServerCall> call_;  // one at a time
  Kind call_kind_ = Kind::kOpen;
  Replica* replica_ = nullptr;  // of the stream
  absl::Duration doubted_at_ = -absl::InfiniteDuration();
  bool wants_export_ = false;  // the engine on the robot needs the session's value
  bool had_stream_ = false;

  // Episodes that the stream has settled, whose futures are not complete yet.
  std::vector<std::pair<Ending, v1::EndEpisodeResponse>> settled_ ABSL_GUARDED_BY(state_->mutex);
  // EndEpisode waits for the head of a fleet that a store keeps, and the stream does not.
  bool waits_for_merge_ ABSL_GUARDED_BY(state_->mutex) = false;
  bool is_open_ ABSL_GUARDED_BY(state_->mutex) = true;               // the server has the session
  bool is_stored_ ABSL_GUARDED_BY(state_->mutex) = false;            // a store may have it, too
  std::set<const Replica*> without_ ABSL_GUARDED_BY(state_->mutex);  // have denied it in a row
  std::optional<absl::Duration> denied_since_ ABSL_GUARDED_BY(state_->mutex);
  bool keeps_beats_ ABSL_GUARDED_BY(state_->mutex) = true;  // when the session is given up
  bool call_done_ ABSL_GUARDED_BY(state_->mutex) = false;
  std::optional<std::string> lost_ ABSL_GUARDED_BY(state_->mutex);  // why the session is given up
  std::optional<absl::Status> stream_end_ ABSL_GUARDED_BY(state_->mutex);
  absl::Duration replied_at_ ABSL_GUARDED_BY(state_->mutex) = -absl::InfiniteDuration();
  absl::Duration next_try_ ABSL_GUARDED_BY(state_->mutex) = -absl::InfiniteDuration();
  absl::Duration pause_ ABSL_GUARDED_BY(state_->mutex);  // before the next try
  std::vector<std::string> lines_ ABSL_GUARDED_BY(state_->mutex);
  std::array<bool, kReplaced> logged_ ABSL_GUARDED_BY(state_->mutex) = {};
};

}  // namespace spikeserve::piloting

#endif  // CLIENT_SRC_PILOT_LINK_H_
