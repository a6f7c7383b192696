#include <string>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "client/spikectl/admin_actions.h"
#include "client/spikectl/admin_call.h"
#include "client/spikectl/operator_servers.h"
#include "client/spikectl/traffic_report.h"
#include "core/base/status_macros.h"
#include "proto/json.h"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

ServerAnswer Paused(const AdminFlags& flags, bool paused) {
  const std::string& policy = flags.policy;
  return ServerAnswer{absl::StrCat(policy.empty() ? "every policy" : policy, ": learning ",
                                   paused ? "paused" : "resumed"),
                      {{"policy", policy}, {"paused", paused}}};
}

}  // namespace

absl::StatusOr<ServerAnswer> ShowHead(const AdminFlags& flags) {
  auto request = HeadRequest<v1::GetHeadRequest>(flags);
  request.set_include_weights(flags.weights);
  ASSIGN_OR_RETURN(const auto head, CallAdmin(flags, &AdminStub::GetHead, request));
  ordered_json json = MessageToFields(head, Numbers::kExact);
  if (!request.include_weights()) {
    json.erase("base");
    json.erase("delta");
  }
  return ServerAnswer{
      absl::StrFormat("%s/%d: drift %.4g, %d updates, %d refused, %d rollbacks, %d fleet "
                      "sessions%s",
                      head.policy(), head.version(), head.drift(), head.updates(),
                      head.rejected_updates(), head.rollbacks(), head.sessions(),
                      head.paused() ? "; learning is paused" : ""),
      json};
}

absl::StatusOr<ServerAnswer> PromoteHead(const AdminFlags& flags) {
  auto request = HeadRequest<v1::PromoteHeadRequest>(flags);
  request.set_make_default(flags.make_default);
  ASSIGN_OR_RETURN(const auto promoted, CallAdmin(flags, &AdminStub::PromoteHead, request));
  return TrafficAnswer(
      absl::StrCat("wrote and loaded ", request.policy(), "/", promoted.version(), ": ",
                   promoted.path()),
      {{"policy", request.policy()}, {"version", promoted.version()}, {"path", promoted.path()}},
      promoted.traffic());
}

absl::StatusOr<ServerAnswer> RollbackHead(const AdminFlags& flags) {
  const auto request = HeadRequest<v1::RollbackHeadRequest>(flags);
  ASSIGN_OR_RETURN(const auto rolled_back, CallAdmin(flags, &AdminStub::RollbackHead, request));
  return ServerAnswer{absl::StrFormat("%s: the policy's own head again; its drift was %.4g",
                                      request.policy(), rolled_back.drift()),
                      {{"policy", request.policy()}, {"drift", rolled_back.drift()}},
                      rolled_back.shared()};
}

absl::StatusOr<ServerAnswer> UndoCorrections(const AdminFlags& flags) {
  auto request = HeadRequest<v1::UndoCorrectionsRequest>(flags);
  request.set_session_id(flags.session);
  request.set_operator_id(flags.operator_id);
  request.set_seconds(absl::ToDoubleSeconds(flags.last));
  const bool of_session = !flags.session.empty();
  ASSIGN_OR_RETURN(
      const auto undone,
      of_session ? OperatorServers(*flags.servers).OfSession(&AdminStub::UndoCorrections, request)
                 : CallAdmin(flags, &AdminStub::UndoCorrections, request));
  return ServerAnswer{absl::StrFormat("%s: took out %d updates by %s; the head's drift is %.4g",
                                      of_session ? flags.session : flags.policy, undone.updates(),
                                      flags.operator_id, undone.head_drift()),
                      {{"updates", undone.updates()}, {"head_drift", undone.head_drift()}},
                      of_session};
}

absl::StatusOr<ServerAnswer> PauseLearning(const AdminFlags& flags) {
  v1::PauseLearningRequest request;
  request.set_policy(flags.policy);
  RETURN_IF_ERROR(CallAdmin(flags, &AdminStub::PauseLearning, request).status());
  return Paused(flags, true);
}

absl::StatusOr<ServerAnswer> ResumeLearning(const AdminFlags& flags) {
  v1::ResumeLearningRequest request;
  request.set_policy(flags.policy);
  RETURN_IF_ERROR(CallAdmin(flags, &AdminStub::ResumeLearning, request).status());
  return Paused(flags, false);
}

}  // namespace spikeserve
