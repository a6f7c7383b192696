#include "spikeserve/pilot.h"

#include <utility>

#include "absl/strings/str_cat.h"
#include "client/src/pilot/cockpit.h"
#include "client/src/replicas.h"
#include "spikeserve/retry.h"

namespace spikeserve {
namespace {

// Brings an opened session to the engine on the robot. Returns OK if only the server could not be
// reached: the background thread tries again.
absl::Status ResumeLocal(Client* client, const std::string& session_id,
                         const std::shared_ptr<Route>& route, LocalPolicy* local,
                         piloting::Link* link) {
  const auto exported = client->ExportSession(session_id, local->NeedsPolicyFile(), route);
  if (!exported.ok()) {
    return IsRetryable(exported.status()) ? absl::OkStatus() : exported.status();
  }
  return link->Resume(*exported);
}

absl::StatusOr<piloting::ActionValue> NeutralOf(const PilotOptions& options,
                                                const v1::OpenSessionResponse& opened) {
  const piloting::ActionShape shape(opened.action_space());
  const v1::Action& neutral =
      options.neutral.has_value() ? *options.neutral : opened.neutral_action();
  piloting::ActionValue value;
  if (shape.Fit(piloting::ViewOf(neutral), &value)) return value;
  return absl::InvalidArgumentError(
      absl::StrCat("neutral: expected an action of the policy's action space, received {",
                   neutral.ShortDebugString(), "}"));
}

}  // namespace

absl::StatusOr<std::unique_ptr<Pilot>> Pilot::Create(Client* client, v1::OpenSessionRequest request,
                                                     PilotOptions options) {
  if (absl::Status status = options.Validate(); !status.ok()) return status;
  request.set_period_seconds(absl::ToDoubleSeconds(options.period));
  const std::shared_ptr<Route> route = MakeRoute();
  const auto opened = client->OpenSession(request, route);
  if (!opened.ok()) return opened.status();
  const std::string& id = opened->session_id();
  const auto close_after = [&](absl::Status status) {
    (void)client->CloseSession(id, route);  // otherwise the session ends by itself
    return status;
  };
  if (opened->history_limit() == 0) {
    return close_after(absl::UnimplementedError(
        "server: expected a release that appends beats, received an older one"));
  }
  const auto neutral = NeutralOf(options, *opened);
  if (!neutral.ok()) return close_after(neutral.status());
  LocalPolicy* const local = options.local.get();
  auto cockpit =
      std::make_unique<Cockpit>(client->replicas_.get(), client->crew_.get(), route,
                                std::move(request), *opened, *neutral, std::move(options));
  if (local != nullptr) {
    const absl::Status status = ResumeLocal(client, id, route, local, &cockpit->link());
    if (!status.ok()) return close_after(status);
  }
  cockpit->link().Start();
  return std::unique_ptr<Pilot>(new Pilot(std::move(cockpit)));
}

Pilot::Pilot(std::unique_ptr<Cockpit> cockpit) : cockpit_(std::move(cockpit)) {}

Pilot::~Pilot() { Close(); }

PilotAction Pilot::Beat(absl::Span<const float> observation, double reward,
                        const std::optional<ActionView>& executed) noexcept {
  return cockpit_->Beat(observation, reward, executed);
}

std::future<Pilot::Summary> Pilot::EndEpisode(const EpisodeOutcome& outcome) {
  return cockpit_->EndEpisode(outcome);
}

bool Pilot::WaitReady(absl::Duration timeout) { return cockpit_->WaitReady(timeout); }

PilotStats Pilot::Stats() const { return cockpit_->Stats(); }

std::string Pilot::session_id() const { return cockpit_->session_id(); }

void Pilot::Close() { cockpit_->link().Close(cockpit_->options().close_timeout); }

}  // namespace spikeserve
