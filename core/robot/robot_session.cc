#include "core/robot/robot_session.h"

#include <algorithm>
#include <utility>

namespace spikeserve::robot {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;

constexpr Time kFirstPause = milliseconds(50);
constexpr Time kLongestPause = milliseconds(200);
constexpr Time kSilence = milliseconds(300);  // without an answer, then a fresh connection is tried
constexpr Time kServerSilence = seconds(1);   // then another server
constexpr Time kLongestWait = seconds(1);
constexpr Time kDenied = seconds(2);

// Returns whether a session is given up after an error that no further request can heal.
bool IsLost(Failure kind) {
  return kind == Failure::kNotFound || kind == Failure::kConflict || kind == Failure::kInvalid;
}

// Returns whether another export may succeed.
bool MayExportAgain(const Error& error) {
  return error.kind == Failure::kNotFound || error.kind == Failure::kAway ||
         error.retry_after.has_value();
}

}  // namespace

RobotSession::RobotSession(const Settings& settings, const ActionShape& shape,
                           const Opening& opening, Now now)
    : settings_(settings),
      log_(settings.kept_steps, settings.observation_size, shape),
      fallback_(shape, settings.neutral, settings.hold_steps, settings.oldest_held,
                settings.ramp_steps, now.robot),
      counters_(now.steady),
      local_(settings.has_engine),
      answer_({.action = settings.neutral}),
      decided_here_({.action = settings.neutral}),
      fitted_(settings.neutral),
      denied_(settings.servers),
      transport_(settings.sends_datagrams, settings.period),
      window_(settings.most_in_flight),
      pause_(kFirstPause) {
  TakeOpening(opening);
}

Task RobotSession::Next(Time now) {
  if (link_ == LinkState::kClosed) return {Task::Kind::kStop};
  if (log_.is_too_long()) GiveUp("the server has missed too many beats");
  if (link_ == LinkState::kGivenUp) return Forget();
  const bool is_over = now >= closes_at_ || !log_.oldest().has_ended();
  if (is_closing() && is_over) return {Task::Kind::kStop};
  if (link_ == LinkState::kBroken) return {Task::Kind::kCloseStream};
  if (MaySend(now)) return Send(now);
  if (local_.Prepare(log_)) return {Task::Kind::kPlay};

  Task wait = {.time = std::min(now + kLongestWait, closes_at_)};
  const bool may_try = now >= next_try_;
  if (!may_try) wait.time = std::min(wait.time, next_try_);
  if (link_ == LinkState::kNoSession) {
    if (!may_try || call_ != CallState::kNone) return wait;
    return Begin(CallState::kOpenSession, Task::Kind::kOpenSession);
  }
  if (link_ == LinkState::kNoStream) {
    if (may_try) return {Task::Kind::kOpenStream};
  } else {
    wait = NextOnline(now, wait);
    if (wait.kind != Task::Kind::kWait) return wait;
  }
  if (!may_try || call_ != CallState::kNone) return wait;
  // In this order: only the end shows that the server has lost an older one, before which there is
  // nothing to export.
  if (log_.is_complete() && !EndsOnStream()) {
    return Begin(CallState::kEndEpisode, Task::Kind::kEndEpisode);
  }
  if (local_.wants_export()) return Begin(CallState::kExportSession, Task::Kind::kExportSession);
  return wait;
}

std::optional<Task> RobotSession::NextSend(Time now) {
  if (log_.is_too_long() || !MaySend(now)) return std::nullopt;
  return Send(now);
}

// Tries a fresh connection, or another server, if requests wait for too long.
Task RobotSession::NextOnline(Time now, Task wait) {
  if (now < paused_until_) wait.time = std::min(wait.time, paused_until_);
  if (in_flight_.empty()) return wait;
  const Time since = std::max(in_flight_.front().sent, replied_at_);
  if (now - since >= kServerSilence && is_stored_ && settings_.servers > 1) {
    Break(Broken::kFailed);
    return {Task::Kind::kCloseStream};
  }
  const Time due = std::max(since, doubted_at_) + kSilence;
  if (now >= due) {
    doubted_at_ = now;
    return {.kind = Task::Kind::kDoubtLine, .time = since};
  }
  wait.time = std::min(wait.time, due);
  return wait;
}

Task RobotSession::Begin(CallState call, Task::Kind kind) {
  call_ = call;
  return {kind};
}

Task RobotSession::Forget() {
  Log("the session is lost, and a new one is opened: " + lost_reason_);
  local_.Stop();
  answer_.step.reset();
  decided_here_.step.reset();
  log_.BeginAgain(std::exchange(keeps_steps_, true));
  link_ = LinkState::kNoSession;
  if (call_ != CallState::kOpenSession) call_ = CallState::kNone;
  return {.kind = Task::Kind::kForget,
          .serial = log_.running().serial,
          .reason = std::move(lost_reason_)};
}

bool RobotSession::MaySend(Time now) const {
  if (log_.is_current()) {
    if (!queued_.has_value()) return false;
    const Ways ways = OpenWays(now);
    return ways.stream || ways.datagram;
  }
  return link_ == LinkState::kOnline && MaySendEnd(now);
}

// A server takes a last step without an observation only together with the end.
bool RobotSession::EndsOnStream() const {
  return ends_by_ == EndsBy::kStream || log_.oldest().last.back().observation.empty();
}

// Returns whether a request for the oldest episode, which has ended, may be sent now.
bool RobotSession::MaySendEnd(Time now) const {
  if (log_.is_ending() || now < paused_until_ || call_ == CallState::kEndEpisode) return false;
  if (!EndsOnStream()) return in_flight_.empty() && !log_.is_complete();
  return in_flight_.empty() || (log_.FitsOne() && in_flight_.size() < window_);
}

Task RobotSession::Send(Time now) {
  Task task = {.kind = Task::Kind::kSend, .request = log_.NextRequest()};
  Request& request = task.request;
  request.ends = request.episode->has_ended() && EndsOnStream() && log_.FitsOne();
  if (request.ends || log_.is_current()) task.ways = OpenWays(now);
  if (request.ends) {
    log_.BeginEnd();
  } else if (log_.is_current()) {
    queued_.reset();
  }
  request.report = counters_.TakeReport(now);
  const SentRequest sent = {.episode = request.episode->index,
                            .number = request.end,
                            .sent = now,
                            .ends = request.ends,
                            .asks = request.asks,
                            .id = next_datagram_};
  if (task.ways.stream) in_flight_.Push(sent);
  if (task.ways.datagram) {
    datagrams_.Push(sent);
    transport_.OnSent(now);
    task.datagram = next_datagram_++;
    task.copies = settings_.redundancy;
  }
  return task;
}

void RobotSession::OnStreamOpened(size_t server) {
  server_ = server;
  counters_.counts().reconnects = streams_++;
  link_ = LinkState::kOnline;
  // EndEpisode waits for the head of a fleet that a store keeps, and the stream does not.
  ends_by_ = is_stored_ && settings_.shares_head ? EndsBy::kCall : EndsBy::kStream;
}

Received RobotSession::OnReply(const Reply& reply, Now now) {
  Received received;
  if (link_ != LinkState::kOnline || in_flight_.empty()) return received;
  // An answer alone is no work.
  received.has_work =
      reply.error != nullptr || !log_.is_current() || log_.is_ending() || queued_.has_value();
  const SentRequest sent = in_flight_.Pop();
  replied_at_ = now.steady;
  if (reply.error != nullptr) {
    ++counters_.counts().cancelled_requests;
    TakeError(*reply.error, sent, now.steady);
    return received;
  }
  if (reply.stays_safe || reply.action.has_value()) StaySafe(reply.stays_safe);
  if (sent.episode == log_.oldest().index) {
    Succeeded();
    TakeAnswered(reply, sent, now, &received);
  }
  return received;
}

void RobotSession::TakeAnswered(const Reply& reply, const SentRequest& sent, Now now,
                                Received* received) {
  log_.ForgetDurable(reply.durable_decision, reply.durable_episode);
  if (sent.ends) {
    received->settled = TakeEnd(reply);
  } else {
    log_.Acknowledge(reply.next_step);
    if (reply.action.has_value()) TakeDecision(reply, sent, now);
  }
}

// The newest answer wins: those to older datagrams tell nothing that it does not.
Received RobotSession::OnDatagram(uint64_t number, const Reply& reply, Now now) {
  if (number >= next_datagram_) return {};
  while (!datagrams_.empty() && datagrams_.front().id < number) datagrams_.Pop();
  if (datagrams_.empty() || datagrams_.front().id != number || !has_session()) return {};
  const SentRequest sent = datagrams_.Pop();
  if (reply.error != nullptr) {
    // What an error means for the session is left to the stream.
    if (reply.error->retry_after.has_value()) {
      paused_until_ = now.steady + *reply.error->retry_after;
    } else {
      transport_.OnError(/*is_order=*/reply.error->expected_decision.has_value());
    }
    return {.has_work = true};
  }
  transport_.OnAnswer(sent.sent, now.steady);
  datagram_answered_ = sent.sent;
  ++counters_.counts().datagram_answers;
  Received received = {.has_work = !log_.is_current() || log_.is_ending() || queued_.has_value()};
  if (sent.episode == log_.oldest().index) TakeAnswered(reply, sent, now, &received);
  return received;
}

std::optional<Settled> RobotSession::TakeEnd(const Reply& reply) {
  if (reply.has_ended) return Settle(reply.episode_return);
  // A server of an earlier release has taken the steps, and ignored the end.
  ends_by_ = EndsBy::kCall;
  log_.AbandonEnd();
  log_.Acknowledge(reply.next_step);
  return std::nullopt;
}

// The robot knows all rewards: if the server has another sum, some were lost there or doubled.
Settled RobotSession::Settle(std::optional<double> at_server) {
  const Episode& episode = log_.oldest();
  const Settled settled = {.serial = episode.serial,
                           .steps = episode.steps,
                           .lost_steps = episode.lost_steps,
                           .episode_return = episode.episode_return()};
  if (at_server.value_or(settled.episode_return) != settled.episode_return) {
    ++counters_.counts().unequal_returns;
    Log("episode " + std::to_string(episode.index) + ": expected the return " +
        std::to_string(settled.episode_return) + ", received " + std::to_string(*at_server));
  }
  log_.Settle(is_stored_);
  if (settings_.shares_head) local_.Outdated();
  return settled;
}

void RobotSession::StaySafe(bool stays_safe) {
  if (stays_safe) answer_.step.reset();  // an earlier answer that was not executed
  if (stays_safe == std::exchange(stays_safe_, stays_safe)) return;
  Log(stays_safe ? "the server keeps the robot at its safe action" : "the server acts again");
}

void RobotSession::TakeDecision(const Reply& reply, const SentRequest& sent, Now now) {
  const Time took = now.steady - sent.sent;
  round_trip_ = round_trip_.has_value() ? *round_trip_ + (took - *round_trip_) / 8 : took;
  const Time age = now.robot - reply.observed_at;
  if (age > settings_.period) ++counters_.counts().late_answers;
  if (age > settings_.oldest) {
    // More requests would only make the queue longer.
    window_ = std::max<size_t>(1, window_ / 2);
    ++counters_.counts().stale;
    return;
  }
  window_ = std::min(window_ + 1, settings_.most_in_flight);
  if (stays_safe_) return;
  if (answer_.step.has_value() && sent.number <= *answer_.step) return;
  answer_.step.reset();
  if (log_.shape().Fit(*reply.action, &answer_.action)) answer_.step = sent.number;
  answer_.chooser.Assign(Fit(reply.chooser));
  if (answer_.chooser.kind == Chooser::kUnknown) answer_.chooser.kind = Chooser::kPolicy;
  answer_.observed_at = reply.observed_at;
}

void RobotSession::TakeError(const Error& error, const SentRequest& sent, Time now) {
  const bool is_oldest = sent.episode == log_.oldest().index;
  const bool is_end = sent.ends && is_oldest;
  if (is_end) log_.AbandonEnd();
  if (error.expected_decision.has_value()) {
    // A request behind an end that failed, or one that was sent twice, fails without consequence.
    if (!is_oldest) return;
    // A datagram that was sent later was answered since: the error is of before.
    if (sent.sent <= datagram_answered_) return;
    // A datagram has brought the end, whose answer is under way, before this request.
    if (log_.is_ending() && error.expected_episode.value_or(0) > sent.episode) return;
    // The server has lost what it had acknowledged, the ends of episodes, too, and gets it again.
    // If it has lost nothing, it has another end of the episode.
    const bool is_kept = log_.Rewind(*error.expected_decision, error.expected_episode);
    const bool is_same = sent.episode == log_.oldest().index;
    if (!is_kept || (is_end && is_same && log_.is_complete())) GiveUp(error.message);
  } else if (error.retry_after.has_value()) {
    paused_until_ = now + *error.retry_after;
  } else if (error.kind == Failure::kNotFound && MayBeElsewhere(server_, now)) {
    LogFailure(error.text);
    PauseTries(now);
    Break(Broken::kLeft);
  } else if (IsLost(error.kind)) {
    GiveUp(error.message, error.kind != Failure::kInvalid);
  } else {
    LogFailure(error.text);
    PauseTries(now);
    Break(Broken::kFailed);
  }
}

void RobotSession::OnStreamEnded(const Error& error) {
  if (link_ != LinkState::kOnline) return;  // the robot has ended it
  broken_text_ = error.text;
  Break(Broken::kEnded);
}

bool RobotSession::OnStreamClosed(bool is_renewed, Time now) {
  if (link_ == LinkState::kBroken) link_ = LinkState::kNoStream;
  if (broken_ == Broken::kEnded && is_renewed) {
    next_try_ = kLongAgo;
    return false;
  }
  if (broken_ == Broken::kLeft) return false;
  denied_.assign(denied_.size(), false);
  if (broken_ == Broken::kEnded) {
    LogFailure(broken_text_);
    PauseTries(now);
  }
  return true;
}

void RobotSession::OnOpened(const Opening& opening) {
  call_ = CallState::kNone;
  link_ = LinkState::kNoStream;
  ++counters_.counts().reopened;
  TakeOpening(opening);
  Succeeded();
}

void RobotSession::TakeOpening(const Opening& opening) {
  is_stored_ = opening.is_stored;
  denied_.assign(denied_.size(), false);
  denied_since_ = kNever;
  log_.set_history_limit(opening.history_limit);
}

bool RobotSession::OnExported(uint64_t decision, int64_t episode, int64_t step, Time now) {
  call_ = CallState::kNone;
  if (local_.Resumed(decision, episode, step, log_)) {
    Succeeded();
    return true;
  }
  LogFailure("export: expected one before a kept beat, received one at step " +
             std::to_string(step) + " of episode " + std::to_string(episode));
  PauseTries(now);
  return false;
}

Settled RobotSession::OnEpisodeEnded(std::optional<double> episode_return) {
  call_ = CallState::kNone;
  Succeeded();
  return Settle(episode_return);
}

void RobotSession::OnCallFailed(const Error& error, size_t server, Time now) {
  if (std::exchange(call_, CallState::kNone) == CallState::kExportSession &&
      !MayExportAgain(error)) {
    local_.Refused();
    Log("the engine on the robot is not used: " + error.text);
    return;
  }
  const bool is_kept = error.expected_decision.has_value() &&
                       log_.Rewind(*error.expected_decision, error.expected_episode);
  const bool is_elsewhere = error.kind == Failure::kNotFound && MayBeElsewhere(server, now);
  if (has_session() && IsLost(error.kind) && !is_kept && !is_elsewhere) {
    GiveUp(error.message, error.kind != Failure::kInvalid);
  } else {
    LogFailure(error.text);
  }
  PauseTries(now);
  if (error.retry_after.has_value()) next_try_ = now + *error.retry_after;
}

void RobotSession::OnPlayed(const ActionView* action, std::string_view text, Time now) {
  if (action == nullptr) {
    Log("the engine on the robot failed: " + std::string(text));
    local_.Stop();
    PauseTries(now);
    return;
  }
  const std::optional<uint64_t> number = local_.Commit();
  if (!number.has_value()) return;
  decided_here_.step = *number;
  decided_here_.action.Assign(*action);
}

bool RobotSession::Stop() {
  const bool is_open = has_session();
  LeaveStream();
  datagrams_.Clear();
  local_.Stop();
  answer_.step.reset();
  log_.BeginAgain();
  link_ = LinkState::kClosed;
  call_ = CallState::kNone;
  return is_open;
}

bool RobotSession::has_session() const {
  return link_ == LinkState::kNoStream || link_ == LinkState::kOnline ||
         link_ == LinkState::kBroken;
}

bool RobotSession::MayBeElsewhere(size_t server, Time now) {
  if (!is_stored_) return false;
  denied_since_ = std::min(denied_since_, now);
  denied_[server] = true;
  if (std::all_of(denied_.begin(), denied_.end(), [](bool is_denied) { return is_denied; })) {
    denied_.assign(denied_.size(), false);
  }
  return now - denied_since_ < kDenied;
}

void RobotSession::GiveUp(std::string_view reason, bool keeps_steps) {
  lost_reason_ = reason;
  keeps_steps_ = keeps_steps;
  link_ = LinkState::kGivenUp;
  LeaveStream();
  datagrams_.Clear();
  transport_.Withdraw();
}

void RobotSession::Break(Broken why) {
  broken_ = why;
  link_ = LinkState::kBroken;
  LeaveStream();
}

void RobotSession::LeaveStream() {
  counters_.counts().cancelled_requests += in_flight_.size();
  in_flight_.Clear();
  log_.AbandonEnd();
  queued_.reset();
  window_ = settings_.most_in_flight;
}

void RobotSession::PauseTries(Time now) {
  next_try_ = now + pause_;
  pause_ = std::min(2 * pause_, kLongestPause);
}

void RobotSession::Succeeded() {
  denied_.assign(denied_.size(), false);
  denied_since_ = kNever;
  pause_ = kFirstPause;
  next_try_ = kLongAgo;
}

void RobotSession::LogFailure(std::string_view text) {
  if (pause_ == kFirstPause) Log(std::string(text));
}

std::vector<std::string> RobotSession::TakeLines() {
  constexpr std::array<std::string_view, kNotices> kNames = {
      "", "reward: expected a finite number", "executed: expected an action of the action space",
      "fallback: expected an action of the action space"};
  for (size_t i = 0; i < kNotices; ++i) {
    if (notices_[i] != Logged::kDue) continue;
    notices_[i] = Logged::kDone;
    lines_.push_back(i == kObservation
                         ? invalid_.ToString() + " (logged once)"
                         : std::string(kNames[i]) + ", received another one (logged once)");
  }
  while (const auto change = fallback_.TakeChange()) {
    lines_.push_back(std::string(SourceName(change->to)) + " after " +
                     std::to_string(change->steps) + " beats " +
                     std::string(SourceName(change->from)));
  }
  return std::exchange(lines_, {});
}

}  // namespace spikeserve::robot
