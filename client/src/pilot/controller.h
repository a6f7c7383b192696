// The threads and calls around a robot's end of a session, core/robot, which decides everything.
//
// The robot's own thread waits for decisions within the budget of a beat, and allocates no memory.
// A background thread does what RobotSession::Next wants, again and again, without blocking for
// long. The pilots of one client share it; one with an engine on the robot, which computes, has one
// of its own. Replies arrive on threads of gRPC.
//
// For one thread, but Stats and session_id.
#pragma once

#include <condition_variable>
#include <cstdint>
#include <future>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "client/src/action_stream.h"
#include "client/src/pilot/background_thread.h"
#include "client/src/pilot/datagram_link.h"
#include "client/src/pilot/server_call.h"
#include "client/src/replicas.h"
#include "core/robot/robot_session.h"
#include "spikeserve/pilot.h"

namespace spikeserve {

class Pilot::Controller : private ActionStream::Listener,
                          private piloting::DatagramLink::Listener,
                          private piloting::BackgroundThread::Worker {
 public:
  // `opening` has opened the session with the answer `opened`, on `route`. `neutral` belongs to its
  // action space. `background` is that of the client. The arguments must outlive the controller.
  Controller(Replicas* replicas, piloting::BackgroundThread* background,
             std::shared_ptr<Route> route, v1::OpenSessionRequest opening,
             const v1::OpenSessionResponse& opened, const robot::ActionValue& neutral,
             PilotOptions options);
  ~Controller() override;

  // Brings the session to the engine on the robot, if there is one. Only before Start. Returns OK
  // if only the server could not be reached: the background thread tries again.
  absl::Status Resume(Client* client) ABSL_LOCKS_EXCLUDED(mutex_);
  // Lets the background thread work.
  void Start();

  // Those of Pilot.
  PilotAction Beat(absl::Span<const float> observation, double reward,
                   const std::optional<ActionView>& executed) ABSL_LOCKS_EXCLUDED(mutex_);
  std::future<Summary> EndEpisode(const EpisodeOutcome& outcome) ABSL_LOCKS_EXCLUDED(mutex_);
  bool WaitReady(absl::Duration timeout) ABSL_LOCKS_EXCLUDED(mutex_);
  PilotStats Stats() const ABSL_LOCKS_EXCLUDED(mutex_);
  std::string session_id() const ABSL_LOCKS_EXCLUDED(mutex_);
  void Close() ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  // On the robot's thread: controller.cc.
  absl::string_view Traceparent() const;
  // Takes the action of the robot's own function, which may ask the pilot for its counts.
  PilotAction TakeOwn(absl::Span<const float> observation) ABSL_LOCKS_EXCLUDED(mutex_);
  PilotAction Finish() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Waits for an event or `deadline`, of SteadyNow().
  void Wait(absl::Duration deadline) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  // On the background thread, then that of Close: background_work.cc.
  std::optional<absl::Duration> Work() override ABSL_LOCKS_EXCLUDED(mutex_);
  // `request` is that of a task that sends.
  void Do(const robot::Task& task, v1::ActRequest* request) ABSL_LOCKS_EXCLUDED(mutex_);
  void Fill(const robot::Request& request, v1::ActRequest* message)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void WriteLog(const std::vector<std::string>& lines) const;
  void Forget(const robot::Task& task) ABSL_LOCKS_EXCLUDED(mutex_);
  void OpenStream() ABSL_LOCKS_EXCLUDED(mutex_);
  void CloseStream() ABSL_LOCKS_EXCLUDED(mutex_);
  void Play() ABSL_LOCKS_EXCLUDED(mutex_);
  void OpenSession();
  void ExportSession() ABSL_LOCKS_EXCLUDED(mutex_);
  void CallEndEpisode() ABSL_LOCKS_EXCLUDED(mutex_);
  piloting::ServerCall& NewCall();
  void TakeCall(robot::CallState kind) ABSL_LOCKS_EXCLUDED(mutex_);
  bool TakeExported(const v1::ExportSessionResponse& exported)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void TakeOpened(const v1::OpenSessionResponse& opened) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Passes on what the session has `received` with `reply`.
  void Take(const robot::Received& received, const v1::ActResponse& reply)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void TakeChannel(const v1::DatagramChannel& channel) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void Send(const robot::Task& task, v1::ActRequest* request);
  void Stop() ABSL_LOCKS_EXCLUDED(mutex_);
  size_t IndexOf(const Replica* replica) const;

  // On threads of gRPC.
  void OnReply(v1::ActResponse&& reply) override ABSL_LOCKS_EXCLUDED(mutex_);
  void OnEnd(const absl::Status& status) override ABSL_LOCKS_EXCLUDED(mutex_);

  // On the thread of the datagrams.
  void OnDatagram(uint64_t number, const v1::ActResponse& reply) override
      ABSL_LOCKS_EXCLUDED(mutex_);

  // Completes the summaries of the episodes before `serial` with an error.
  void FailSummaries(uint64_t serial, absl::string_view reason)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Completes the summary of an episode, if it is awaited.
  void Complete(const robot::Settled& settled, v1::EndEpisodeResponse summary)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const PilotOptions options_;
  Replicas* const replicas_;
  const std::shared_ptr<Route> route_;
  std::vector<Replica*> servers_;
  std::unique_ptr<piloting::BackgroundThread> own_background_;  // null: that of the client is used
  piloting::BackgroundThread* const background_;
  const robot::ActionValue neutral_;
  const std::unique_ptr<piloting::DatagramLink> datagrams_;  // null: none are sent
  const std::vector<float> no_observation_;                  // NaN in each element
  bool is_started_ = false;
  uint64_t beats_ = 0;

  // Of the background thread, and after it of Close.
  v1::OpenSessionRequest opening_;  // has an id while it is under way
  std::unique_ptr<ActionStream> stream_;
  std::unique_ptr<piloting::ServerCall> call_;  // one at a time
  Replica* replica_ = nullptr;                  // of the stream

  mutable absl::Mutex mutex_;
  // Notified after each event. A CondVar of Abseil would measure its timeouts by the time of day.
  std::condition_variable_any has_event_;
  robot::RobotSession session_ ABSL_GUARDED_BY(mutex_);
  std::string session_id_ ABSL_GUARDED_BY(mutex_);
  bool is_call_done_ ABSL_GUARDED_BY(mutex_) = false;
  std::map<uint64_t, std::promise<Summary>> summaries_ ABSL_GUARDED_BY(mutex_);  // by serial number
};

}  // namespace spikeserve
