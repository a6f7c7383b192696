// The robot's end of a session: every control step has an action in time, and the server's session
// becomes what happened on the robot, whatever the link does.
//
// A pure state machine. Events go in (a control step, a reply, the end of a stream or of a call,
// time), tasks come out; it has no thread, no clock and no connection. docs/reference/beats.md has
// the table of its states, row by row.
//
//   session.BeginStep({.observation = observation, .reward = reward}, now);
//   while (session.Choose(now, deadline) == Choice::kWait) ...  // for an event, or the deadline
//   const StepResult step = session.FinishStep(now);
//
//   const Task task = session.Next(now);  // again and again, on another thread: does it, and says
//   session.OnReply(reply, now);          // what became of it
//
// A control step allocates no memory after the first ones. Times are those of Now. Not thread-safe.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/robot/action_shape.h"
#include "core/robot/counters.h"
#include "core/robot/fallback_order.h"
#include "core/robot/in_flight.h"
#include "core/robot/link_events.h"
#include "core/robot/local_session.h"
#include "core/robot/observation.h"
#include "core/robot/step_log.h"
#include "core/robot/time.h"

namespace spikeserve::robot {

// spikeserve::PilotOptions says what each one is.
struct Settings {
  size_t observation_size = 0;
  ActionValue neutral = {};
  Time period = Time::zero();
  Time oldest = Time::zero();       // age from which on an answer is stale
  Time oldest_held = Time::zero();  // age from which on an action is not held
  int hold_steps = 0;
  int ramp_steps = 0;
  size_t most_in_flight = 1;  // at most InFlight::kMost
  size_t kept_steps = 2;
  size_t servers = 1;            // that may have the session
  bool has_engine = false;       // on the robot
  bool shares_head = false;      // the session learns with a fleet
  bool sends_datagrams = false;  // where the server takes them and they come through
  int redundancy = 1;            // copies of each datagram
};

// Where the session is. docs/reference/beats.md names the transitions.
enum class LinkState {
  kNoSession,  // the server has none
  kNoStream,   // there is a session
  kOnline,     // there is a stream, too
  kBroken,     // the stream has failed, and is to be closed
  kGivenUp,    // the session is lost
  kClosed,     // the robot has closed it
};
enum class CallState { kNone, kOpenSession, kExportSession, kEndEpisode };

struct StepInput {
  std::span<const float> observation;
  double reward = 0.0;                   // for the action of the step before
  const ActionView* executed = nullptr;  // in the step before; null: what was chosen
  // Of `executed`. kUnknown: what chose the action for the robot, if it is that one.
  ChooserView chooser = {};
  std::string_view traceparent = "";
};

struct StepResult {
  ActionView action;    // until the next call
  ChooserView chooser;  // of it; until the next call
  Source source;
  Time age;  // of the observation that it was chosen for
};

enum class Choice {
  kTaken,      // FinishStep has the action
  kWait,       // for an event
  kOwnAction,  // TakeOwn is to be called with the action of the robot's own function
};

class RobotSession {
 public:
  // `opening` has opened the session. The neutral action belongs to `shape`.
  RobotSession(const Settings& settings, const ActionShape& shape, const Opening& opening, Now now);

  // A control step, in three parts. BeginStep returns false if no observation was valid yet: there
  // is no step then, and invalid_observation() says why.
  bool BeginStep(const StepInput& input, Now now);
  // Takes the best action, or says why there is none yet. Waits for nothing from `deadline` on.
  Choice Choose(Now now, Time deadline);
  // Takes the robot's own action; null, or one that does not belong to the action space: the
  // function has failed, and the neutral one is taken.
  void TakeOwn(const ActionView* action);
  StepResult FinishStep(Now now);

  // Ends the episode; the next step begins another one. Returns its serial number, or nothing if it
  // has no step or the session is closed.
  std::optional<uint64_t> EndEpisode(Outcome outcome, const ActionView* executed,
                                     const ChooserView& chooser = {});
  // Returns whether the server's newest answer may be executed.
  bool HasAnswer() const { return answer_.step.has_value() && *answer_.step >= next_answer_; }
  // Asks for the newest step if nothing is under way: no control step does it meanwhile.
  void AskAgain(Now now);
  // Ends everything when the server has the ends of all episodes, or at `at`.
  void Close(Time at) { closes_at_ = at; }

  // Returns what is to be done next. Of calls, one is under way at a time.
  Task Next(Time now);
  // As Next, for a thread of the robot that sends by itself: returns what is to be sent, if
  // anything.
  std::optional<Task> NextSend(Time now);

  // The stream that Next has wanted is open, at a server by its number.
  void OnStreamOpened(size_t server);
  Received OnReply(const Reply& reply, Now now);
  // The server offers a channel of datagrams until then, in the place of the one before.
  void OnChannel(Time until) { transport_.Offer(until); }
  // As OnReply, for the answer to the datagram of this number. One that is late, or comes twice,
  // has no effect.
  Received OnDatagram(uint64_t number, const Reply& reply, Now now);
  // The stream has ended by itself.
  void OnStreamEnded(const Error& error);
  // The stream is closed. `is_renewed`: a fresh connection has taken the place of its own. Returns
  // whether its server has failed.
  bool OnStreamClosed(bool is_renewed, Time now);
  // The call is over.
  void OnOpened(const Opening& opening);
  // The engine on the robot has resumed from an export, before this decision, which is that of
  // `step` of `episode`. Returns false if it cannot go on from there.
  bool OnExported(uint64_t decision, int64_t episode, int64_t step, Time now);
  Settled OnEpisodeEnded(std::optional<double> episode_return);  // as in Reply
  void OnCallFailed(const Error& error, size_t server, Time now);
  // The engine on the robot has played work(). Null: it has failed, because of `text`.
  void OnPlayed(const ActionView* action, std::string_view text, Time now);
  // Nothing is done any more. Returns whether the server has a session to close.
  bool Stop();

  LinkState link() const { return link_; }
  CallState call() const { return call_; }
  const StepLog& step_log() const { return log_; }
  const Counters& counters() const { return counters_; }
  const FallbackOrder& fallback() const { return fallback_; }
  const LocalSession& local() const { return local_; }
  const LocalWork& work() const { return local_.work(); }
  const InvalidObservation& invalid_observation() const { return invalid_; }
  // Returns whether steps go as datagrams alone.
  bool SendsDatagrams(Time now) const { return !transport_.Choose(now).stream; }
  bool sees() const { return sees_; }  // the observation of the last step was valid
  // The server keeps the robot at its safe action (Reply::stays_safe).
  bool stays_safe() const { return stays_safe_; }
  bool is_closing() const { return closes_at_ < kNever; }
  bool shares_head() const { return settings_.shares_head; }
  // Returns whether a server has denied the session, after which another one is asked.
  bool HasDenied(size_t server) const { return denied_[server]; }
  // Returns what is to be logged, once.
  std::vector<std::string> TakeLines();

 private:
  // A decision of the server, or of the engine on the robot.
  struct Decision {
    std::optional<uint64_t> step = std::nullopt;  // its number; absent: there is none
    ActionValue action = {};
    ChooserValue chooser = {};
    Time observed_at = kLongAgo;
  };
  enum class EndsBy { kStream, kCall };  // episodes; old servers, and merged heads, need a call
  enum class Broken {
    kEnded,   // by itself
    kFailed,  // its server does not answer, or not rightly
    kLeft,    // for another server
  };
  // What was not valid; each kind is logged once.
  enum Notice { kObservation, kReward, kExecuted, kFallback, kNotices };
  enum class Logged { kNone, kDue, kDone };

  // control_step.cc
  void Queue(uint64_t number, bool sees, Time now);
  // Returns how a request for the newest step may go now.
  Ways OpenWays(Time now) const;
  bool AwaitsAnswer(Time now, Time deadline) const;
  std::optional<uint64_t> ExpectedAnswer(Time now, Time deadline) const;
  bool TakeAnswer(Now now);
  double Finite(double reward);
  void TakeExecuted(const ActionView* executed, const ChooserView& chooser);
  void Note(Notice kind);

  // robot_session.cc
  Task NextOnline(Time now, Task wait);
  Task Forget();
  bool MaySend(Time now) const;
  bool MaySendEnd(Time now) const;
  bool EndsOnStream() const;  // the oldest episode, which has ended
  Task Send(Time now);
  Task Begin(CallState call, Task::Kind kind);
  // Of a request for the oldest episode.
  void TakeAnswered(const Reply& reply, const SentRequest& sent, Now now, Received* received);
  std::optional<Settled> TakeEnd(const Reply& reply);
  Settled Settle(std::optional<double> at_server);
  void StaySafe(bool stays_safe);
  void TakeDecision(const Reply& reply, const SentRequest& sent, Now now);
  void TakeError(const Error& error, const SentRequest& sent, Time now);
  void TakeOpening(const Opening& opening);
  bool has_session() const;
  // Notes that a server does not know the session. Returns whether the session may exist all the
  // same: a server that takes it over, or whose store has lost it, may deny it while another one
  // has it. A session that a store has is lost when those that answer have denied it for two
  // seconds.
  bool MayBeElsewhere(size_t server, Time now);
  // Gives the session up. A step that the server has refused as not valid would be refused again.
  void GiveUp(std::string_view reason, bool keeps_steps = true);
  void Break(Broken why);
  void LeaveStream();
  void PauseTries(Time now);
  void Succeeded();
  void Log(std::string line) { lines_.push_back(std::move(line)); }
  // Logs the first one of several failures.
  void LogFailure(std::string_view text);

  const Settings settings_;
  StepLog log_;
  FallbackOrder fallback_;
  Counters counters_;
  LocalSession local_;
  Decision answer_;  // the newest ones
  Decision decided_here_;

  // The control step.
  uint64_t step_ = 0;  // its number
  bool sees_ = false;
  Time observed_at_ = kLongAgo;
  bool is_proven_ = false;    // an observation was valid
  bool stays_safe_ = false;   // says the newest reply, also of a session before
  uint64_t began_ = 0;        // number of the first step of the robot's episode
  uint64_t next_answer_ = 0;  // answers to older steps are not executed
  ActionValue fitted_;        // an action of the caller, with its elements in bounds
  InvalidObservation invalid_;

  // The link.
  LinkState link_ = LinkState::kNoStream;
  CallState call_ = CallState::kNone;
  EndsBy ends_by_ = EndsBy::kStream;
  Broken broken_ = Broken::kLeft;
  std::string broken_text_;
  std::string lost_reason_;
  bool keeps_steps_ = true;  // when the session is given up
  bool is_stored_ = false;
  size_t server_ = 0;                  // of the stream
  std::vector<bool> denied_;           // by server
  Time denied_since_ = kNever;         // kNever: no server denies it
  std::optional<SentRequest> queued_;  // to be sent
  InFlight in_flight_;                 // on the stream
  InFlight datagrams_;                 // in flight
  uint64_t next_datagram_ = 0;         // its number
  Time datagram_answered_ = kLongAgo;  // when the newest one with an answer was sent
  TransportChoice transport_;
  size_t window_;                   // most requests in flight
  std::optional<Time> round_trip_;  // smoothed
  Time replied_at_ = kLongAgo;
  Time doubted_at_ = kLongAgo;
  Time paused_until_ = kLongAgo;  // no requests before, as the server asked
  Time next_try_ = kLongAgo;      // no calls and no streams before
  Time pause_;                    // before the next try
  Time closes_at_ = kNever;       // kNever: the session is open
  uint64_t streams_ = 0;
  std::vector<std::string> lines_;
  std::array<Logged, kNotices> notices_ = {};
};

}  // namespace spikeserve::robot
