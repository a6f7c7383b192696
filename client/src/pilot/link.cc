#include "client/src/pilot/link.h"

#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/src/steady_time.h"
#include "spikeserve/status.h"

namespace spikeserve::piloting {
namespace {

constexpr absl::Duration kCallTimeout = absl::Seconds(2);  // then the call is made again
constexpr absl::Duration kCloseTimeout = absl::Seconds(1);
constexpr absl::Duration kFirstPause = absl::Milliseconds(50);
constexpr absl::Duration kLongestPause = absl::Milliseconds(200);
constexpr absl::Duration kGiveUp = absl::Seconds(1);  // without an answer, then another server
constexpr absl::Duration kLongestLinkWait = absl::Seconds(1);
constexpr absl::Duration kDenied = absl::Seconds(2);
constexpr std::array<absl::string_view, kReplaced> kReplacedNames = {
    "observation",  // Blindness::ToString says more
    "reward: expected a finite number", "executed: expected an action of the action space",
    "fallback: expected an action of the action space"};

// Returns whether a session is given up after an error that no further request can heal.
bool IsLost(const absl::Status& error) {
  return absl::IsNotFound(error) || absl::IsFailedPrecondition(error) ||
         absl::IsInvalidArgument(error) || absl::IsDataLoss(error);
}

// Returns whether another export may succeed.
bool MayExportAgain(const absl::Status& error) {
  return absl::IsNotFound(error) || IsRetryable(error) || IsRefusedForNow(error);
}

}  // namespace

absl::Status LostEpisode(absl::string_view reason) {
  return absl::UnavailableError(absl::StrCat("the server has not learned the end: ", reason));
}

Link::Link(Replicas* replicas, BackgroundThread* background, Route* route,
           v1::OpenSessionRequest opening, const v1::OpenSessionResponse& opened,
           const PilotOptions* options, SharedState* state)
    : replicas_(replicas),
      route_(route),
      options_(*options),
      state_(state),
      own_background_(options->local == nullptr ? nullptr : std::make_unique<BackgroundThread>()),
      background_(own_background_ == nullptr ? background : own_background_.get()),
      opening_(std::move(opening)),
      local_(options->local),
      wants_export_(options->local != nullptr),
      pause_(kFirstPause) {
  state_->background = background_;
  state_->worker = this;
  absl::MutexLock lock(&state_->mutex);
  state_->shares_head = opening_.learning().scope() == v1::LearningConfig::FLEET;
  state_->window = options_.most_in_flight();
  TakeOpened(opened);
}

Link::~Link() { Close(absl::ZeroDuration()); }

absl::Status Link::Resume(const v1::ExportSessionResponse& exported) {
  if (absl::Status status = local_.policy()->Resume(exported); !status.ok()) return status;
  absl::MutexLock lock(&state_->mutex);
  const absl::Status status = local_.Resumed(exported, state_->log);
  state_->has_local = status.ok();
  wants_export_ = !status.ok();
  return status;
}

void Link::Start() {
  is_started_ = true;
  background_->Add(this);
}

void Link::Close(absl::Duration timeout) {
  if (!std::exchange(is_started_, false)) return;
  {
    absl::MutexLock lock(&state_->mutex);
    state_->closes_at = SteadyNow() + timeout;
    state_->NotifyWork();
  }
  background_->AwaitEnd(this);
  Stop();
}

std::optional<absl::Duration> Link::Work() {
  while (true) {
    Step step = nullptr;
    absl::Duration until;
    {
      absl::MutexLock lock(&state_->mutex);
      step = Plan(SteadyNow(), &until);
    }
    if (step == nullptr) return until;
    if (step == &Link::Stop) return std::nullopt;
    (this->*step)();
  }
}

Link::Step Link::Plan(absl::Duration now, absl::Duration* until) {
  *until = now + kLongestLinkWait;
  if (state_->log.is_too_long()) lost_ = "the server has missed too many beats";
  if (lost_.has_value()) return &Link::Lose;
  if (!settled_.empty()) return &Link::CompleteSettled;
  if (state_->closes_at.has_value()) {
    if (now >= *state_->closes_at || !state_->log.oldest().ending.has_value()) return &Link::Stop;
    *until = std::min(*until, *state_->closes_at);
  }
  if (!lines_.empty() || state_->fallback.has_change() || state_->replaced != logged_) {
    return &Link::WriteLog;
  }
  if (call_done_) return &Link::TakeCall;
  if (stream_ != nullptr && !state_->is_connected) return &Link::DropStream;
  const bool asks = state_->queued.has_value() && state_->log.is_current() &&
                    state_->under_way.size() < state_->window;
  if (asks || MaySendEnd(now)) return &Link::SendRequest;
  if (local_.is_ready()) {
    if (local_.Prepare(state_->log)) return &Link::CatchUp;
    if (!local_.is_ready()) StopLocal();
  }
  return PlanCalls(now, until);
}

Link::Step Link::PlanCalls(absl::Duration now, absl::Duration* until) {
  const bool may_try = now >= next_try_;
  if (!may_try) *until = std::min(*until, next_try_);
  if (!is_open_) return may_try && call_ == nullptr ? &Link::OpenSession : nullptr;
  if (stream_ == nullptr) {
    if (may_try) return &Link::OpenStream;
  } else {
    if (now < state_->paused_until) *until = std::min(*until, state_->paused_until);
    *until = std::min(*until, Doubt(now));
  }
  if (may_try && call_ == nullptr) {
    if (wants_export_) return &Link::ExportSession;
    if (!state_->ends_on_stream && state_->log.is_complete()) return &Link::EndEpisode;
  }
  return nullptr;
}

bool Link::MaySendEnd(absl::Duration now) {
  const bool has_ended = state_->log.oldest().ending.has_value() && !state_->log.is_ending();
  if (!state_->is_connected || !has_ended || now < state_->paused_until) return false;
  if (call_ != nullptr && call_kind_ == Kind::kEnd) return false;
  if (!state_->ends_on_stream) return state_->under_way.empty() && !state_->log.is_complete();
  return state_->under_way.empty() ||
         (state_->log.FitsOne() && state_->under_way.size() < state_->window);
}

void Link::CompleteSettled() {
  std::vector<std::pair<Ending, v1::EndEpisodeResponse>> settled;
  {
    absl::MutexLock lock(&state_->mutex);
    settled.swap(settled_);
    wants_export_ = wants_export_ || (state_->has_local && state_->shares_head);
  }
  for (auto& [ending, summary] : settled) ending.summary.set_value(std::move(summary));
}

absl::Duration Link::Doubt(absl::Duration now) {
  if (state_->under_way.empty()) return absl::InfiniteDuration();
  const absl::Duration since = std::max(state_->under_way.front().sent, replied_at_);
  if (now - since >= kGiveUp && replicas_->MayMove(*route_)) {
    ReplicaFailed();
    EndStream();
    return now;
  }
  absl::Duration due = std::max(since, doubted_at_) + kLineSilence;
  if (now >= due) {
    doubted_at_ = now;
    replica_->connection.Doubt(since);
    due = now + kLineSilence;
  }
  return due;
}

void Link::Lose() {
  std::vector<Ending> endings;
  std::string reason;
  {
    absl::MutexLock lock(&state_->mutex);
    reason = *std::exchange(lost_, std::nullopt);
    Log(absl::StrCat("the session is lost, and a new one is opened: ", reason));
    EndStream();
    StopLocal();
    is_open_ = false;
    state_->answer.is_there = state_->local.is_there = false;
    endings = state_->log.BeginAgain(std::exchange(keeps_beats_, true));
  }
  stream_.reset();
  if (call_kind_ != Kind::kOpen) call_.reset();
  {
    // A call that was under way may have ended before it was removed.
    absl::MutexLock lock(&state_->mutex);
    stream_end_.reset();
    if (call_ == nullptr) call_done_ = false;
  }
  for (Ending& ending : endings) ending.summary.set_value(LostEpisode(reason));
}

void Link::Stop() {
  std::vector<Ending> endings;
  bool is_open = false;
  v1::CloseSessionRequest request;
  {
    absl::MutexLock lock(&state_->mutex);
    EndStream();
    state_->has_local = false;
    is_open = is_open_;
    request.set_session_id(state_->session_id);
    endings = state_->log.BeginAgain();
  }
  stream_.reset();
  call_.reset();
  CompleteSettled();
  for (Ending& ending : endings) ending.summary.set_value(LostEpisode("the pilot was closed"));
  WriteLog();
  if (!is_open) return;
  ServerCall close(replicas_, route_, kCloseTimeout, [] {});
  close.Begin(request);
  (void)close.Await();  // a session that is not closed ends by itself
}

void Link::WriteLog() {
  std::vector<std::string> lines;
  {
    absl::MutexLock lock(&state_->mutex);
    for (size_t i = 0; i < kReplaced; ++i) {
      if (state_->replaced[i] == logged_[i]) continue;
      logged_[i] = true;
      lines_.push_back(
          static_cast<Replaced>(i) == Replaced::kObservation
              ? absl::StrCat(state_->blindness.ToString(), " (logged once)")
              : absl::StrCat(kReplacedNames[i], ", received another one (logged once)"));
    }
    while (const auto change = state_->fallback.TakeChange()) {
      lines_.push_back(absl::StrCat(ActionSourceName(change->to), " after ", change->beats,
                                    " beats ", ActionSourceName(change->from)));
    }
    lines.swap(lines_);
  }
  if (options_.log == nullptr) return;
  for (const std::string& line : lines) options_.log(line);
}

void Link::CatchUp() {
  const absl::Status status = local_.Play();
  absl::MutexLock lock(&state_->mutex);
  if (!status.ok()) {
    Log(absl::StrCat("the engine on the robot failed: ", status.ToString()));
    StopLocal();
    PauseTries();
    return;
  }
  const auto number = local_.Commit();
  if (!number.has_value()) return;
  state_->local.is_there = true;
  state_->local.number = *number;
  state_->local.action.Assign(local_.action());
  state_->has_decision.notify_all();
}

ServerCall& Link::NewCall(Kind kind, absl::Duration timeout) {
  call_kind_ = kind;
  call_ = std::make_unique<ServerCall>(replicas_, route_, timeout, [this] {
    absl::MutexLock lock(&state_->mutex);
    call_done_ = true;
    state_->NotifyWork();
  });
  return *call_;
}

void Link::OpenSession() {
  replicas_->Pin(*route_, false);
  if (opening_.session_id().empty()) opening_.set_session_id(DrawId());
  NewCall(Kind::kOpen, kCallTimeout).Begin(opening_);
}

void Link::ExportSession() {
  v1::ExportSessionRequest request;
  {
    absl::MutexLock lock(&state_->mutex);
    request.set_session_id(state_->session_id);
  }
  request.set_include_policy(local_.policy()->NeedsPolicyFile());
  NewCall(Kind::kExport, kCallTimeout).Begin(request);
}

void Link::EndEpisode() {
  v1::EndEpisodeRequest request;
  {
    absl::MutexLock lock(&state_->mutex);
    request.set_session_id(state_->session_id);
    state_->log.FillEnd(&request);
  }
  NewCall(Kind::kEnd, kCallTimeout).Begin(request);
}

void Link::TakeCall() {
  const absl::Status status = call_->Await();
  const std::unique_ptr<ServerCall> call = std::move(call_);
  const Kind kind = call_kind_;
  // An engine takes a moment to read its policy.
  const absl::Status resumed =
      status.ok() && kind == Kind::kExport ? local_.policy()->Resume(call->exported()) : status;
  std::optional<Ending> ended;
  v1::EndEpisodeResponse summary;
  {
    absl::MutexLock lock(&state_->mutex);
    call_done_ = false;
    if (!resumed.ok()) {
      CallFailed(kind, call->replica(), resumed);
      return;
    }
    if (kind == Kind::kOpen) {
      if (call->opened().history_limit() == 0) {
        CallFailed(kind, call->replica(),
                   absl::UnimplementedError("server: expected one that appends beats"));
        return;
      }
      TakeOpened(call->opened());
      ++state_->counters.counts().reopened;
    } else if (kind == Kind::kExport) {
      const absl::Status followed = local_.Resumed(call->exported(), state_->log);
      state_->has_local = followed.ok();
      wants_export_ = !followed.ok();
      if (!followed.ok()) {
        LogFailure(followed);
        PauseTries();
        return;
      }
    } else {
      summary = call->ended();
      ended = Settle(&summary);
      wants_export_ = wants_export_ || (state_->has_local && state_->shares_head);
    }
    Succeeded();
  }
  if (ended.has_value()) ended->summary.set_value(std::move(summary));
}

void Link::CallFailed(Kind kind, const Replica* replica, const absl::Status& error) {
  if (kind == Kind::kExport && !MayExportAgain(error)) {
    wants_export_ = false;
    Log(absl::StrCat("the engine on the robot is not used: ", error.ToString()));
    return;
  }
  const auto expected = ExpectedDecision(error);
  const bool is_kept =
      expected.has_value() && state_->log.Rewind(*expected, ExpectedEpisode(error));
  const bool is_elsewhere = absl::IsNotFound(error) && MayBeElsewhere(replica);
  if (is_open_ && IsLost(error) && !is_kept && !is_elsewhere) {
    GiveUp(error);
  } else {
    LogFailure(error);
  }
  PauseTries();
  if (const auto after = RetryAfter(error)) next_try_ = SteadyNow() + *after;
}

void Link::TakeOpened(const v1::OpenSessionResponse& opened) {
  const bool is_stored = opened.durability() == v1::ASYNC || opened.durability() == v1::SYNC;
  replicas_->Pin(*route_, !is_stored);
  is_stored_ = is_stored;
  without_.clear();
  denied_since_.reset();
  waits_for_merge_ = is_stored && state_->shares_head;
  opening_.clear_session_id();  // the next session is another one
  state_->session_id = opened.session_id();
  state_->log.set_history_limit(opened.history_limit());
  is_open_ = true;
}

void Link::StopLocal() {
  local_.Stop();
  state_->has_local = false;
  wants_export_ = local_.policy() != nullptr;
  state_->has_decision.notify_all();
}

void Link::ReplicaFailed() {
  replicas_->Failed(*replica_);
  without_.clear();
}

void Link::PauseTries() {
  next_try_ = SteadyNow() + pause_;
  pause_ = std::min(2 * pause_, kLongestPause);
}

bool Link::MayBeElsewhere(const Replica* replica) {
  if (!is_stored_) return false;
  const absl::Duration now = SteadyNow();
  if (!denied_since_.has_value()) denied_since_ = now;
  without_.insert(replica);
  if (without_.size() == replicas_->size()) without_.clear();
  return now - *denied_since_ < kDenied;
}

void Link::GiveUp(const absl::Status& error) {
  lost_ = std::string(error.message());
  keeps_beats_ = !absl::IsInvalidArgument(error);
}

Ending Link::Settle(v1::EndEpisodeResponse* summary) {
  summary->set_lost_steps(static_cast<int64_t>(state_->log.oldest().lost_steps));
  return state_->log.Settle(is_stored_);
}

void Link::Succeeded() {
  without_.clear();
  denied_since_.reset();
  pause_ = kFirstPause;
  next_try_ = -absl::InfiniteDuration();
}

void Link::Log(std::string line) {
  lines_.push_back(std::move(line));
  state_->NotifyWork();
}

void Link::LogFailure(const absl::Status& error) {
  if (pause_ == kFirstPause) Log(error.ToString());
}

}  // namespace spikeserve::piloting
