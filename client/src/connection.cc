#include "client/src/connection.h"

#include <algorithm>
#include <array>
#include <chrono>
#include <condition_variable>
#include <utility>

#include "absl/time/clock.h"
#include "client/src/lockable.h"
#include "client/src/steady_time.h"
#include "spikeserve/status.h"

namespace spikeserve {
namespace {

constexpr absl::Duration kTick = absl::Milliseconds(100);        // of the watch
constexpr absl::Duration kIdle = absl::Seconds(1);               // then the watch waits
constexpr absl::Duration kRaceTime = absl::Seconds(1);           // for the health checks
constexpr absl::Duration kGrace = absl::Milliseconds(50);        // for the line that calls wait on
constexpr absl::Duration kFirstPause = absl::Milliseconds(100);  // after a race; doubled each time
constexpr absl::Duration kLongestPause = absl::Seconds(5);

// Returns whether a server or a proxy has answered a call that ended with `status`.
bool IsAnswer(const absl::Status& status) {
  return !absl::IsUnavailable(status) && !absl::IsDeadlineExceeded(status) &&
         !absl::IsCancelled(status);
}

// Two health checks, of which the first that is answered wins; the second one only if the first is
// not answered for kGrace either: on a busy machine, answers change places.
class HealthRace {
 public:
  explicit HealthRace(const std::array<Line*, 2>& lines) {
    for (size_t i = 0; i < lines.size(); ++i) {
      Check& check = checks_[i];
      check.context.set_deadline(absl::ToChronoTime(absl::Now() + kRaceTime));
      lines[i]->health->async()->Check(
          &check.context, &check.request, &check.response,
          [this, i](const grpc::Status& status) { Ended(static_cast<int>(i), status); });
    }
  }

  // Returns the index of the winner, or -1. All checks have ended then.
  int Await() {
    absl::MutexLock lock(&mutex_);
    mutex_.Await(absl::Condition(this, &HealthRace::IsDecided));
    if (winner_ == 1) {
      Lockable lockable(&mutex_);
      first_ended_.wait_for(lockable, absl::ToChronoMilliseconds(kGrace), [this] {
        mutex_.AssertHeld();
        return has_first_ended_;
      });
    }
    for (Check& check : checks_) check.context.TryCancel();
    mutex_.Await(absl::Condition(this, &HealthRace::IsOver));
    return winner_;
  }

 private:
  struct Check {
    grpc::ClientContext context;
    grpc::health::v1::HealthCheckRequest request;
    grpc::health::v1::HealthCheckResponse response;
  };

  bool IsDecided() const ABSL_SHARED_LOCKS_REQUIRED(mutex_) { return winner_ >= 0 || IsOver(); }
  bool IsOver() const ABSL_SHARED_LOCKS_REQUIRED(mutex_) { return ended_ == 2; }

  void Ended(int i, const grpc::Status& status) {
    absl::MutexLock lock(&mutex_);
    if ((winner_ < 0 || i == 0) && IsAnswer(StatusFromGrpc(status))) winner_ = i;
    ++ended_;
    if (i != 0) return;
    has_first_ended_ = true;
    first_ended_.notify_all();
  }

  std::array<Check, 2> checks_;
  absl::Mutex mutex_;
  std::condition_variable_any first_ended_;
  bool has_first_ended_ ABSL_GUARDED_BY(mutex_) = false;
  int winner_ ABSL_GUARDED_BY(mutex_) = -1;
  int ended_ ABSL_GUARDED_BY(mutex_) = 0;
};

}  // namespace

Line::Line(std::shared_ptr<grpc::Channel> to)
    : channel(std::move(to)),
      stub(v1::PolicyService::NewStub(channel)),
      health(grpc::health::v1::Health::NewStub(channel)) {}

RenewableConnection::Watched::Watched(RenewableConnection* connection, grpc::ClientContext* context,
                                      bool expects_answer)
    : connection_(connection),
      context_(context),
      began_(SteadyNow()),
      expects_answer_(expects_answer) {
  absl::MutexLock lock(&connection_->mutex_);
  line_ = connection_->line_;
  connection_->calls_.insert(this);
  connection_->WakeWatch();
}

RenewableConnection::Watched::~Watched() {
  absl::MutexLock lock(&connection_->mutex_);
  connection_->calls_.erase(this);
}

absl::Status RenewableConnection::Watched::Note(const absl::Status& status) const {
  if (IsAnswer(status)) {
    connection_->Answered();
  } else if (absl::IsDeadlineExceeded(status)) {
    connection_->Missed(began_);
  } else if (absl::IsCancelled(status) && connection_->line() != line_) {
    return absl::UnavailableError("the connection did not answer and was replaced by a fresh one");
  }
  return status;
}

RenewableConnection::RenewableConnection(std::shared_ptr<grpc::Channel> channel, Connector connect)
    : connect_(std::move(connect)),
      line_(std::make_shared<Line>(std::move(channel))),
      pause_(kFirstPause) {}

RenewableConnection::~RenewableConnection() {
  std::thread watch;
  {
    absl::MutexLock lock(&mutex_);
    is_stopping_ = true;
    changed_.notify_all();
    watch = std::move(watch_);
  }
  if (watch.joinable()) watch.join();
}

std::shared_ptr<Line> RenewableConnection::line() {
  absl::MutexLock lock(&mutex_);
  return line_;
}

void RenewableConnection::Answered() {
  absl::MutexLock lock(&mutex_);
  answered_at_ = SteadyNow();
  silent_since_ = absl::InfiniteDuration();
  misses_ = 0;
}

void RenewableConnection::Missed(absl::Duration began) {
  absl::MutexLock lock(&mutex_);
  if (began < answered_at_) return;
  silent_since_ = std::min(silent_since_, began);
  if (++misses_ < kLineMisses || SteadyNow() - silent_since_ < kLineSilence) return;
  is_asked_ = true;
  WakeWatch();
}

void RenewableConnection::Doubt(absl::Duration since) {
  absl::MutexLock lock(&mutex_);
  if (SteadyNow() - std::max(since, answered_at_) < kLineSilence) return;
  is_asked_ = true;
  WakeWatch();
}

void RenewableConnection::WakeWatch() {
  if (connect_ == nullptr) return;
  if (!watch_.joinable()) {
    watch_ = std::thread([this] { Watch(); });
  } else if (is_parked_ || is_asked_) {
    changed_.notify_all();
  }
}

bool RenewableConnection::IsDoubtful(absl::Duration now) {
  if (std::exchange(is_asked_, false)) return true;
  return std::any_of(calls_.begin(), calls_.end(), [&](const Watched* call) {
    mutex_.AssertHeld();
    return call->expects_answer_ && now - std::max(call->began_, answered_at_) >= kLineSilence;
  });
}

void RenewableConnection::Watch() {
  while (true) {
    Work work;
    {
      absl::MutexLock lock(&mutex_);
      if (is_stopping_) return;
      work = TakeWork();
      if (work.ended.empty() && !work.races) Wait();
    }
    if (work.races) Race();
  }
}

RenewableConnection::Work RenewableConnection::TakeWork() {
  Work work;
  for (auto& line : retired_) {
    if (line.use_count() == 1) work.ended.push_back(std::move(line));  // no call has it
  }
  std::erase(retired_, nullptr);
  const absl::Duration now = SteadyNow();
  if (!calls_.empty()) busy_at_ = now;
  work.races = now >= next_race_ && IsDoubtful(now);
  return work;
}

void RenewableConnection::Wait() {
  Lockable lockable(&mutex_);
  if (is_asked_ || !calls_.empty() || !retired_.empty() || SteadyNow() - busy_at_ < kIdle) {
    changed_.wait_for(lockable, absl::ToChronoMilliseconds(kTick));
    return;
  }
  is_parked_ = true;
  changed_.wait(lockable);
  is_parked_ = false;
  busy_at_ = SteadyNow();
}

void RenewableConnection::Race() {
  const std::shared_ptr<grpc::Channel> channel = connect_();
  if (channel == nullptr) return;
  const auto fresh = std::make_shared<Line>(channel);
  const std::shared_ptr<Line> old = line();
  const bool fresh_won = HealthRace({old.get(), fresh.get()}).Await() == 1;
  absl::MutexLock lock(&mutex_);
  pause_ = fresh_won ? kFirstPause : std::min(2 * pause_, kLongestPause);
  next_race_ = SteadyNow() + pause_;
  misses_ = 0;
  silent_since_ = absl::InfiniteDuration();
  is_asked_ = false;
  if (!fresh_won) return;
  line_ = fresh;
  for (Watched* call : calls_) {
    if (call->line_ == old) call->context_->TryCancel();
  }
  retired_.push_back(old);
}

}  // namespace spikeserve
