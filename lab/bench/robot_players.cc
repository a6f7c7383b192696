#include "lab/bench/robot_players.h"

#include <algorithm>
#include <future>
#include <optional>
#include <utility>

#include "absl/time/clock.h"
#include "spikeserve/client.h"
#include "spikeserve/local_engine.h"
#include "spikeserve/pilot.h"
#include "spikeserve/remote_session.h"

namespace spikeserve {
namespace {

constexpr absl::Duration kPatience = absl::Seconds(30);  // with the beginning and the end

Comparison Compare(int64_t server, int64_t robot) {
  return {.doubled = std::max<int64_t>(0, server - robot),
          .missing = std::max<int64_t>(0, robot - server)};
}

v1::OpenSessionRequest Opening(const PlayerOptions& options) {
  v1::OpenSessionRequest request;
  request.set_policy(options.policy);
  request.set_period_seconds(absl::ToDoubleSeconds(options.period));
  return request;
}

class Caller final : public RobotPlayer {
 public:
  Caller(std::unique_ptr<Client> patient, std::unique_ptr<Client> quick, std::string session_id)
      : patient_(std::move(patient)),
        quick_(std::move(quick)),
        session_(quick_.get(), std::move(session_id), /*step=*/0) {
    last_.mutable_continuous()->add_values(0.0f);
  }

  Executed Act(absl::Span<const float> observation, double reward) override {
    const absl::Time now = absl::Now();
    const auto answer = session_.Act(observation, reward, last_);
    Executed executed;
    if (answer.ok()) {
      executed.source = ActionSource::kFresh;
      observed_at_ = now;
      last_ = answer->action();
    } else if (observed_at_ != absl::InfinitePast()) {
      executed.source = ActionSource::kHeld;
    }
    executed.action.assign(last_.continuous().values().begin(), last_.continuous().values().end());
    if (executed.source != ActionSource::kSafe) executed.age = absl::Now() - observed_at_;
    return executed;
  }

  void EndEpisode(double reward, int64_t beats) override {
    v1::EndEpisodeRequest request;
    request.set_session_id(session_.session_id());
    request.set_reward(reward);
    request.set_truncated(true);
    *request.mutable_executed_action() = last_;
    const auto ended = patient_->EndEpisode(request);
    result_.Add(Compare(ended.ok() ? ended->steps() : 0, beats));
    session_ = RemoteSession(quick_.get(), session_.session_id(), /*step=*/0);
  }

  Comparison Finish() override { return result_; }

 private:
  const std::unique_ptr<Client> patient_;  // ends episodes
  const std::unique_ptr<Client> quick_;
  RemoteSession session_;
  v1::Action last_;
  absl::Time observed_at_ = absl::InfinitePast();  // the observation of the last answer
  Comparison result_;
};

class PilotPlayer final : public RobotPlayer {
 public:
  PilotPlayer(std::shared_ptr<Client> client, std::unique_ptr<Pilot> pilot)
      : client_(std::move(client)), pilot_(std::move(pilot)) {}

  Executed Act(absl::Span<const float> observation, double reward) override {
    const PilotAction action = pilot_->Beat(observation, reward);
    const absl::Span<const float> values = action.value.continuous;
    return {.action = {values.begin(), values.end()}, .source = action.source, .age = action.age};
  }

  void EndEpisode(double reward, int64_t beats) override {
    summaries_.emplace_back(pilot_->EndEpisode({.reward = reward, .truncated = true}), beats);
  }

  Comparison Finish() override {
    pilot_->Close();
    Comparison result;
    for (auto& [summary, beats] : summaries_) {
      const Pilot::Summary ended = summary.get();
      result.Add(Compare(ended.ok() ? ended->steps() : 0, beats));
    }
    return result;
  }

 private:
  const std::shared_ptr<Client> client_;
  const std::unique_ptr<Pilot> pilot_;
  std::vector<std::pair<std::future<Pilot::Summary>, int64_t>> summaries_;
};

}  // namespace

absl::StatusOr<std::unique_ptr<RobotPlayer>> MakeCaller(const PlayerOptions& options) {
  auto patient = Client::Connect(options.servers, {}, kPatience);
  if (!patient.ok()) return patient.status();
  const auto opened = (*patient)->OpenSession(Opening(options));
  if (!opened.ok()) return opened.status();
  ClientOptions settings;
  settings.call_timeout = 0.9 * options.period;
  settings.retry.max_attempts = 1;
  auto quick = Client::Connect(options.servers, settings, kPatience);
  if (!quick.ok()) return quick.status();
  return std::make_unique<Caller>(*std::move(patient), *std::move(quick), opened->session_id());
}

absl::StatusOr<std::shared_ptr<Client>> Connect(const PlayerOptions& options) {
  return Client::Connect(options.servers, {}, kPatience);
}

absl::StatusOr<std::unique_ptr<RobotPlayer>> MakePilot(const PlayerOptions& options,
                                                       std::shared_ptr<Client> client) {
  PilotOptions settings = {.period = options.period};
  settings.close_timeout = kPatience;
  settings.log = nullptr;
  settings.transport = options.transport;
  settings.redundancy = options.redundancy;
  if (options.has_engine) settings.local = LocalEngine::FromServer();
  auto pilot = Pilot::Create(client.get(), Opening(options), std::move(settings));
  if (!pilot.ok()) return pilot.status();
  return std::make_unique<PilotPlayer>(std::move(client), *std::move(pilot));
}

}  // namespace spikeserve
