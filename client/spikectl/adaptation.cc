#include "client/spikectl/adaptation.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <thread>
#include <utility>

#include "absl/strings/str_format.h"
#include "absl/synchronization/mutex.h"
#include "client/spikectl/agent.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

absl::StatusOr<RemoteSession> Open(Client& client, const AdaptationOptions& options,
                                   v1::OpenSessionRequest request) {
  request.set_policy(options.policy.name());
  request.set_version(options.policy.version());
  return RemoteSession::Open(&client, std::move(request));
}

absl::StatusOr<RemoteSession> OpenLearner(Client& client, const AdaptationOptions& options,
                                          int session) {
  v1::OpenSessionRequest request;
  request.set_seed(options.seed + static_cast<uint64_t>(session));
  request.set_action_selection(v1::SAMPLE);
  request.set_temperature(options.temperature);
  *request.mutable_learning() = options.learning;
  return Open(client, options, std::move(request));
}

// Returns the mean return of a frozen, greedy session over the starts for evaluation.
absl::StatusOr<double> Evaluate(Client& client, const AdaptationOptions& options,
                                Environment& environment, const v1::OpenSessionRequest& request) {
  ASSIGN_OR_RETURN(auto session, Open(client, options, request));
  double sum = 0.0;
  for (int i = 0; i < options.evaluation_episodes; ++i) {
    const uint64_t seed = options.seed + options.evaluation_seed + static_cast<uint64_t>(i);
    ASSIGN_OR_RETURN(const auto episode, PlayEpisode(environment, session, seed));
    sum += episode.episode_return;
  }
  RETURN_IF_ERROR(session.Close());
  return sum / options.evaluation_episodes;
}

// Collects the returns of all sessions, and reports an episode when all sessions have finished it.
class Curve {
 public:
  Curve(const AdaptationOptions& options, const std::function<void(int, double)>& on_episode)
      : sessions_(options.sessions),
        on_episode_(on_episode),
        sums_(static_cast<size_t>(options.episodes), 0.0),
        counts_(static_cast<size_t>(options.episodes), 0) {}

  void Add(int episode, double episode_return) {
    absl::MutexLock lock(&mutex_);
    sums_[static_cast<size_t>(episode)] += episode_return;
    ++counts_[static_cast<size_t>(episode)];
    while (told_ < counts_.size() && counts_[told_] == sessions_) {
      on_episode_(static_cast<int>(told_), sums_[told_] / sessions_);
      ++told_;
    }
  }

  std::vector<double> Means() {
    absl::MutexLock lock(&mutex_);
    std::vector<double> means = sums_;
    for (double& mean : means) mean /= sessions_;
    return means;
  }

 private:
  const int sessions_;
  const std::function<void(int, double)>& on_episode_;
  absl::Mutex mutex_;
  std::vector<double> sums_ ABSL_GUARDED_BY(mutex_);
  std::vector<int> counts_ ABSL_GUARDED_BY(mutex_);
  size_t told_ ABSL_GUARDED_BY(mutex_) = 0;
};

absl::Status LearnAlone(const AdaptationOptions& options, int session, RemoteSession& learner,
                        Curve* curve) {
  ASSIGN_OR_RETURN(const auto environment, MakeTask(options));
  for (int e = 0; e < options.episodes; ++e) {
    const uint64_t start = static_cast<uint64_t>(e) * options.sessions + session;
    ASSIGN_OR_RETURN(const auto episode, PlayEpisode(*environment, learner, options.seed + start));
    curve->Add(e, episode.episode_return);
  }
  return absl::OkStatus();
}

// Plays all learning sessions concurrently, and stores the learned head in `learned`.
absl::Status Learn(Client& client, const AdaptationOptions& options, Curve* curve,
                   v1::GetSessionResponse* learned) {
  std::vector<RemoteSession> learners;
  for (int i = 0; i < options.sessions; ++i) {
    ASSIGN_OR_RETURN(auto learner, OpenLearner(client, options, i));
    learners.push_back(std::move(learner));
  }
  std::vector<absl::Status> statuses(learners.size());
  std::vector<std::thread> threads;
  for (size_t i = 0; i < learners.size(); ++i) {
    threads.emplace_back(
        [&, i] { statuses[i] = LearnAlone(options, static_cast<int>(i), learners[i], curve); });
  }
  for (std::thread& thread : threads) thread.join();
  for (const absl::Status& status : statuses) {
    if (!status.ok()) return status;
  }
  ASSIGN_OR_RETURN(auto session, learners[0].State(/*include_head_delta=*/true));
  *learned = std::move(session);
  for (RemoteSession& learner : learners) {
    RETURN_IF_ERROR(learner.Close());
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<std::unique_ptr<Environment>> MakeTask(const AdaptationOptions& options) {
  if (!options.perturbation.has_value()) return MakeEnvironment(options.environment);
  return MakePerturbedEnvironment(options.environment, *options.perturbation);
}

absl::StatusOr<Adaptation> Adapt(Client& client, const AdaptationOptions& options,
                                 const std::function<void(int, double)>& on_episode) {
  ASSIGN_OR_RETURN(const auto unperturbed, MakeEnvironment(options.environment));
  ASSIGN_OR_RETURN(const auto perturbed, MakeTask(options));

  Adaptation result;
  ASSIGN_OR_RETURN(const auto unperturbed_return, Evaluate(client, options, *unperturbed, {}));
  ASSIGN_OR_RETURN(const auto frozen_return, Evaluate(client, options, *perturbed, {}));

  Curve curve(options, on_episode);
  v1::GetSessionResponse learned;
  RETURN_IF_ERROR(Learn(client, options, &curve, &learned));
  v1::OpenSessionRequest with_head;
  *with_head.mutable_head_delta() = learned.head_delta();
  ASSIGN_OR_RETURN(const auto adapted_return, Evaluate(client, options, *perturbed, with_head));

  return Adaptation{.unperturbed_return = unperturbed_return,
                    .frozen_return = frozen_return,
                    .adapted_return = adapted_return,
                    .curve = curve.Means(),
                    .head_drift = learned.head_drift(),
                    .rollbacks = learned.rollbacks()};
}

std::string CurveLine(int episode, double value, double low, double high) {
  constexpr int kWidth = 50;
  const double part = high > low ? (value - low) / (high - low) : 0.0;
  const int length = static_cast<int>(std::lround(kWidth * std::clamp(part, 0.0, 1.0)));
  return absl::StrFormat("%7d %10.1f |%s\n", episode, value,
                         std::string(static_cast<size_t>(length), '#'));
}

}  // namespace spikeserve
