#include "spikeserve/pilot.h"

#include <functional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/src/pilot/controller.h"
#include "client/src/pilot/robot_messages.h"
#include "client/src/replicas.h"

namespace spikeserve {
namespace {

absl::StatusOr<robot::ActionValue> NeutralOf(const PilotOptions& options,
                                             const v1::OpenSessionResponse& opened,
                                             FeatureOrder order) {
  const robot::ActionShape shape = piloting::ShapeOf(opened.action_space());
  v1::Action neutral = options.neutral.value_or(opened.neutral_action());
  if (options.neutral.has_value()) order.ToPolicy(&neutral);
  robot::ActionValue value;
  if (shape.Fit(piloting::ViewOf(neutral), &value)) return value;
  return absl::InvalidArgumentError(
      absl::StrCat("neutral: expected an action of the policy's action space, received {",
                   neutral.ShortDebugString(), "}"));
}

// Returns an action of the robot as one of the policy. Numbers are no index of a Discrete space,
// unless there is one beside an equal index: a language that does not know the space says both.
ActionView ToPolicy(const ActionView& action, FeatureOrder* order) {
  const absl::Span<const float> numbers = action.continuous;
  const bool is_index =
      numbers.empty() || (numbers.size() == 1 &&
                          static_cast<double>(numbers[0]) == static_cast<double>(action.discrete));
  return {is_index ? order->Action(action.discrete) : -1, order->Action(numbers), action.by};
}

// Returns a robot's function of observations as one of the policy's.
std::function<ActionView(absl::Span<const float>)> Ordered(
    std::function<ActionView(absl::Span<const float>)> fallback, const FeatureOrder& order) {
  if (fallback == nullptr) return nullptr;
  return
      [fallback = std::move(fallback), own = order](absl::Span<const float> observation) mutable {
        return ToPolicy(fallback(own.RobotObservation(observation)), &own);
      };
}

}  // namespace

absl::StatusOr<std::unique_ptr<Pilot>> Pilot::Create(Client* client, v1::OpenSessionRequest request,
                                                     PilotOptions options) {
  if (absl::Status status = options.Validate(); !status.ok()) return status;
  request.set_period_seconds(absl::ToDoubleSeconds(options.period));
  request.set_names_in_any_order(true);
  request.set_datagrams(options.transport != PilotTransport::kStream);
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
  if (options.transport == PilotTransport::kDatagram && !opened->has_datagrams()) {
    return close_after(absl::FailedPreconditionError(
        "transport: expected kAuto or kStream, because the server takes no datagrams, received "
        "kDatagram"));
  }
  const FeatureOrder order(request, *opened);
  const auto neutral = NeutralOf(options, *opened, order);
  if (!neutral.ok()) return close_after(neutral.status());
  options.fallback = Ordered(std::move(options.fallback), order);
  auto controller =
      std::make_unique<Controller>(client->replicas_.get(), client->background_.get(), route,
                                   std::move(request), *opened, *neutral, std::move(options));
  if (absl::Status status = controller->Resume(client); !status.ok()) return close_after(status);
  controller->Start();
  return std::unique_ptr<Pilot>(new Pilot(std::move(controller), order));
}

Pilot::Pilot(std::unique_ptr<Controller> controller, FeatureOrder order)
    : order_(std::move(order)), controller_(std::move(controller)) {}

Pilot::~Pilot() { Close(); }

PilotAction Pilot::Beat(absl::Span<const float> observation, double reward,
                        const std::optional<ActionView>& executed) noexcept {
  std::optional<ActionView> ordered;
  if (executed.has_value()) ordered = ToPolicy(*executed, &order_);
  PilotAction action = controller_->Beat(order_.Observation(observation), reward, ordered);
  action.value = {order_.RobotAction(action.value.discrete),
                  order_.RobotAction(action.value.continuous), action.value.by};
  return action;
}

std::future<Pilot::Summary> Pilot::EndEpisode(const EpisodeOutcome& outcome) {
  EpisodeOutcome ordered = outcome;
  const auto observation = order_.Observation(outcome.observation);
  ordered.observation.assign(observation.begin(), observation.end());
  if (ordered.executed_action.has_value()) order_.ToPolicy(&ordered.executed_action->action);
  return controller_->EndEpisode(ordered);
}

bool Pilot::WaitReady(absl::Duration timeout) { return controller_->WaitReady(timeout); }

PilotStats Pilot::Stats() const { return controller_->Stats(); }

std::string Pilot::session_id() const { return controller_->session_id(); }

void Pilot::Close() { controller_->Close(); }

}  // namespace spikeserve
