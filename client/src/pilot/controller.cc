#include "client/src/pilot/controller.h"

#include <algorithm>
#include <chrono>
#include <limits>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/src/lockable.h"
#include "client/src/pilot/robot_messages.h"
#include "client/src/steady_time.h"

namespace spikeserve {

using piloting::FromRobot;
using piloting::ToRobot;

namespace {

constexpr absl::Duration kAskAgain = absl::Milliseconds(50);

robot::Settings SettingsOf(const PilotOptions& options, const v1::OpenSessionRequest& opening,
                           const v1::OpenSessionResponse& opened, const robot::ActionValue& neutral,
                           size_t servers) {
  return {.observation_size = static_cast<size_t>(opened.observation_size()),
          .neutral = neutral,
          .period = ToRobot(options.period),
          .oldest = ToRobot(options.oldest()),
          .oldest_held = ToRobot(options.oldest_held()),
          .hold_steps = options.hold_beats,
          .ramp_steps = options.ramp(),
          .most_in_flight = options.most_in_flight(),
          .kept_steps = static_cast<size_t>(options.kept_beats),
          .servers = servers,
          .has_engine = options.local != nullptr,
          .shares_head = opening.learning().scope() == v1::LearningConfig::FLEET,
          .sends_datagrams = options.transport != PilotTransport::kStream,
          .redundancy = options.redundancy};
}

}  // namespace

absl::string_view ActionSourceName(ActionSource source) {
  return robot::SourceName(static_cast<robot::Source>(source)).data();
}

Pilot::Controller::Controller(Replicas* replicas, piloting::BackgroundThread* background,
                              std::shared_ptr<Route> route, v1::OpenSessionRequest opening,
                              const v1::OpenSessionResponse& opened,
                              const robot::ActionValue& neutral, PilotOptions options)
    : options_(std::move(options)),
      replicas_(replicas),
      route_(std::move(route)),
      own_background_(options_.local == nullptr ? nullptr
                                                : std::make_unique<piloting::BackgroundThread>()),
      background_(own_background_ == nullptr ? background : own_background_.get()),
      neutral_(neutral),
      datagrams_(options_.transport == PilotTransport::kStream
                     ? nullptr
                     : std::make_unique<piloting::DatagramLink>(
                           static_cast<piloting::DatagramLink::Listener*>(this))),
      no_observation_(static_cast<size_t>(opened.observation_size()),
                      std::numeric_limits<float>::quiet_NaN()),
      opening_(std::move(opening)),
      session_(SettingsOf(options_, opening_, opened, neutral, replicas->size()),
               piloting::ShapeOf(opened.action_space()), piloting::OpeningOf(opened),
               piloting::ReadClocks()) {
  replicas_->ForEach([this](Replica& replica) { servers_.push_back(&replica); });
  absl::MutexLock lock(&mutex_);
  TakeOpened(opened);
}

Pilot::Controller::~Controller() {
  Close();
  if (datagrams_ != nullptr) datagrams_->Stop();  // also if it was never started
}

PilotAction Pilot::Controller::Beat(absl::Span<const float> observation, double reward,
                                    const std::optional<ActionView>& executed) {
  const robot::Now now = piloting::ReadClocks();
  const absl::Duration deadline = FromRobot(now.steady) + options_.wait();
  const absl::string_view traceparent = Traceparent();
  const robot::ActionView view = ToRobot(executed.value_or(ActionView()));
  const robot::ChooserView chooser = ToRobot(executed.value_or(ActionView()).by);
  bool sees = false;
  {
    absl::MutexLock lock(&mutex_);
    const bool is_step =
        session_.BeginStep({.observation = ToRobot(observation),
                            .reward = reward,
                            .executed = executed.has_value() ? &view : nullptr,
                            .chooser = chooser,
                            .traceparent = {traceparent.data(), traceparent.size()}},
                           now);
    background_->Wake(this);
    if (!is_step) {
      return {.value = FromRobot(neutral_.view()),
              .source = ActionSource::kSafe,
              .age = absl::ZeroDuration(),
              .beat = beats_,
              .status = absl::InvalidArgumentError(session_.invalid_observation().ToString())};
    }
    sees = session_.sees();
    auto choice = robot::Choice::kWait;
    while ((choice = session_.Choose(piloting::ReadClocks(), ToRobot(deadline))) ==
           robot::Choice::kWait) {
      Wait(deadline);
    }
    if (choice == robot::Choice::kTaken) return Finish();
  }
  return TakeOwn(sees ? observation : no_observation_);
}

absl::string_view Pilot::Controller::Traceparent() const {
  if (options_.traceparent == nullptr) return "";
  try {
    return options_.traceparent();
  } catch (...) {  // of the robot's own function; a beat never throws
    return "";
  }
}

PilotAction Pilot::Controller::TakeOwn(absl::Span<const float> observation) {
  std::optional<ActionView> own;  // absent: the function has failed
  try {
    own =
        options_.fallback == nullptr ? FromRobot(neutral_.view()) : options_.fallback(observation);
  } catch (...) {  // of the robot's own function; a beat never throws
  }
  const robot::ActionView view = ToRobot(own.value_or(ActionView()));
  absl::MutexLock lock(&mutex_);
  session_.TakeOwn(own.has_value() ? &view : nullptr);
  return Finish();
}

PilotAction Pilot::Controller::Finish() {
  const robot::StepResult step = session_.FinishStep(piloting::ReadClocks());
  return {.value = FromRobot(step.action, step.chooser),
          .source = static_cast<ActionSource>(step.source),
          .age = FromRobot(step.age),
          .beat = beats_++};
}

void Pilot::Controller::Wait(absl::Duration deadline) {
  const absl::Duration left = deadline - SteadyNow();
  if (left <= absl::ZeroDuration()) return;
  Lockable lockable(&mutex_);
  has_event_.wait_for(lockable, absl::ToChronoNanoseconds(left));
}

std::future<Pilot::Summary> Pilot::Controller::EndEpisode(const EpisodeOutcome& outcome) {
  std::optional<robot::ActionView> executed;
  robot::ChooserView chooser;
  if (outcome.executed_action.has_value()) {
    executed = piloting::ViewOf(outcome.executed_action->action);
    chooser = piloting::ViewOf(outcome.executed_action->source);
  }
  std::promise<Summary> summary;
  std::future<Summary> future = summary.get_future();
  absl::MutexLock lock(&mutex_);
  const uint64_t steps = session_.step_log().running().steps;
  const auto serial = session_.EndEpisode({.reward = outcome.reward,
                                           .terminated = outcome.terminated,
                                           .truncated = outcome.truncated,
                                           .target_return = outcome.target_return,
                                           .observation = outcome.observation},
                                          executed.has_value() ? &*executed : nullptr, chooser);
  if (serial.has_value()) {
    summaries_.emplace(*serial, std::move(summary));
    background_->Wake(this);
  } else if (steps > 0) {
    summary.set_value(piloting::LostEpisode(piloting::kClosed));
  } else {
    v1::EndEpisodeResponse empty;
    empty.set_lost_steps(static_cast<int64_t>(session_.step_log().running().lost_steps));
    summary.set_value(std::move(empty));
  }
  return future;
}

bool Pilot::Controller::WaitReady(absl::Duration timeout) {
  const absl::Duration deadline = SteadyNow() + timeout;
  absl::MutexLock lock(&mutex_);
  while (!session_.HasAnswer()) {
    const robot::Now now = piloting::ReadClocks();
    if (FromRobot(now.steady) >= deadline) return false;
    // No beat asks meanwhile: the stream may have opened, or broken, after the last one.
    session_.AskAgain(now);
    background_->Wake(this);
    Wait(std::min(deadline, FromRobot(now.steady) + kAskAgain));
  }
  return true;
}

PilotStats Pilot::Controller::Stats() const {
  absl::MutexLock lock(&mutex_);
  const robot::Counts& counts = session_.counters().counts();
  const robot::Ages& ages = session_.counters().ages();
  const robot::InvalidObservation& invalid = session_.invalid_observation();
  return {.beats = counts.steps,
          .by_source = counts.by_source,
          .entries = session_.fallback().entries(),
          .stale = counts.stale,
          .late_answers = counts.late_answers,
          .cancelled_calls = counts.cancelled_requests,
          .datagram_answers = counts.datagram_answers,
          .sends_datagrams = session_.SendsDatagrams(ToRobot(SteadyNow())),
          .reconnects = counts.reconnects,
          .reopened = counts.reopened,
          .dropped = session_.step_log().dropped(),
          .lost_episodes = session_.step_log().lost_episodes(),
          .unequal_returns = counts.unequal_returns,
          .invalid = counts.invalid,
          .invalid_observations = counts.invalid_observations,
          .last_invalid_observation = invalid.expected > 0 ? invalid.ToString() : "",
          .failures = counts.failures,
          .longest_gap = FromRobot(counts.longest_gap),
          .age_p50 = FromRobot(ages.Quantile(0.5)),
          .age_p99 = FromRobot(ages.Quantile(0.99)),
          .age_p999 = FromRobot(ages.Quantile(0.999)),
          .has_local = session_.local().is_ready(),
          .local_head_is_copy = session_.local().is_ready() && session_.shares_head(),
          .stays_safe = session_.stays_safe()};
}

std::string Pilot::Controller::session_id() const {
  absl::MutexLock lock(&mutex_);
  return session_id_;
}

}  // namespace spikeserve
