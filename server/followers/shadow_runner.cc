#include "server/followers/shadow_runner.h"

#include <sys/resource.h>
#include <sys/time.h>
#include <unistd.h>

#include <utility>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

using prometheus::BuildCounter;

constexpr int kLowestPriority = 19;

prometheus::Labels LabelsOf(const ShadowSession& shadow, int64_t served_version) {
  return {{"policy", shadow.candidate().name},
          {"version", absl::StrCat(served_version)},
          {"shadow_version", absl::StrCat(shadow.candidate().version)}};
}

prometheus::Labels With(prometheus::Labels labels, const char* name, const char* value) {
  labels.emplace(name, value);
  return labels;
}

}  // namespace

ShadowRunner::ShadowRunner(prometheus::Registry& registry)
    : decisions_(BuildCounter()
                     .Name("spikeserve_shadow_decisions_total")
                     .Help("Decisions that a shadow version computed for comparison with the "
                           "serving version, by whether both chose the same action.")
                     .Register(registry)),
      spikes_(BuildCounter()
                  .Name("spikeserve_shadow_spikes_total")
                  .Help("Spikes of the compared decisions, by side: served or shadow.")
                  .Register(registry)),
      dropped_(BuildCounter()
                   .Name("spikeserve_shadow_dropped_total")
                   .Help("Decisions that a shadow version skipped, because its queue was full or "
                         "it had missed an earlier step of the episode.")
                   .Register(registry)),
      thread_([this] { Run(); }) {}

ShadowRunner::~ShadowRunner() {
  {
    absl::MutexLock lock(&mutex_);
    stop_ = true;
  }
  thread_.join();
}

void ShadowRunner::Submit(const std::shared_ptr<ShadowSession>& shadow, int64_t served_version,
                          std::vector<ShadowStep> steps) {
  {
    absl::MutexLock lock(&mutex_);
    if (queue_.size() + steps.size() <= kLongestQueue) {
      for (ShadowStep& step : steps) queue_.push_back({shadow, served_version, std::move(step)});
      return;
    }
  }
  CountDropped(*shadow, served_version, steps.size());
}

void ShadowRunner::Run() {
  // On Linux, PRIO_PROCESS with a thread id sets the priority of that thread alone. If it fails,
  // shadows compete with decisions for processors, which is harmless.
  (void)setpriority(PRIO_PROCESS, static_cast<id_t>(gettid()), kLowestPriority);
  absl::MutexLock lock(&mutex_);
  const auto can_continue = [this]() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    return stop_ || !queue_.empty();
  };
  while (true) {
    mutex_.Await(absl::Condition(&can_continue));
    if (stop_) return;
    const Job job = std::move(queue_.front());
    queue_.pop_front();
    mutex_.Unlock();
    Play(job);
    mutex_.Lock();
  }
}

void ShadowRunner::Play(const Job& job) {
  const auto answer = job.shadow->Act(job.step);
  if (!answer.ok()) return CountDropped(*job.shadow, job.served_version, 1);
  const prometheus::Labels labels = LabelsOf(*job.shadow, job.served_version);
  const ActionSpace& space = job.shadow->candidate().policy().action_space;
  const bool agree = Agree((*answer)->action, job.step.served.action, space);
  decisions_.Add(With(labels, "agreement", agree ? "agree" : "differ")).Increment();
  const auto count_spikes = [&](const char* side, const Answer& counted) {
    spikes_.Add(With(labels, "side", side))
        .Increment(static_cast<double>(counted.counts.total_spikes()));
  };
  count_spikes("shadow", **answer);
  count_spikes("served", job.step.served);
}

void ShadowRunner::CountDropped(const ShadowSession& shadow, int64_t served_version, size_t steps) {
  dropped_.Add(LabelsOf(shadow, served_version)).Increment(static_cast<double>(steps));
}

}  // namespace spikeserve
