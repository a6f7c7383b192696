#include <string>
#include <utility>
#include <vector>

#include "absl/strings/ascii.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_split.h"
#include "absl/strings/strip.h"
#include "absl/time/time.h"
#include "client/spikectl/admin_actions.h"
#include "client/spikectl/traffic_report.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "proto/json.h"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

// Parses MEASURE or MEASURE:PERCENT%.
absl::StatusOr<v1::RolloutCondition> ParseCondition(absl::string_view text) {
  const auto refuse = [&] {
    return absl::InvalidArgumentError(absl::StrCat(
        "--abort_if: expected return, errors or p99, and optionally a margin such as return:5%, ",
        "received \"", text, "\""));
  };
  const std::pair<absl::string_view, absl::string_view> parts =
      absl::StrSplit(text, absl::MaxSplits(':', 1));
  v1::RolloutCondition condition;
  v1::RolloutCondition::Measure measure = v1::RolloutCondition::MEASURE_UNSPECIFIED;
  if (!v1::RolloutCondition::Measure_Parse(
          absl::StrCat("MEASURE_", absl::AsciiStrToUpper(parts.first)), &measure) ||
      measure == v1::RolloutCondition::MEASURE_UNSPECIFIED) {
    return refuse();
  }
  condition.set_measure(measure);
  absl::string_view margin = parts.second;
  if (margin.empty()) return condition;
  double percent = 0.0;
  if (!absl::ConsumeSuffix(&margin, "%") || !absl::SimpleAtod(margin, &percent)) return refuse();
  condition.set_margin(percent / 100.0);
  return condition;
}

absl::StatusOr<v1::StartRolloutRequest> StartRequest(const AdminFlags& flags) {
  auto request = VersionRequest<v1::StartRolloutRequest>(flags);
  for (const std::string& text : flags.steps) {
    int32_t percent = 0;
    if (!absl::SimpleAtoi(absl::StripSuffix(text, "%"), &percent)) {
      return InvalidArgument("--steps", "percentages such as 1,10,50,100",
                             absl::StrCat("\"", text, "\""));
    }
    request.add_steps(percent);
  }
  request.set_hold_seconds(absl::ToDoubleSeconds(flags.hold));
  request.set_min_episodes(flags.min_episodes);
  for (const std::string& text : flags.abort_if) {
    ASSIGN_OR_RETURN(const auto condition, ParseCondition(text));
    *request.add_abort_if() = condition;
  }
  if (!flags.require_ope.empty()) {
    auto report = ReadFile(flags.require_ope);
    if (!report.ok()) return Annotate(report.status(), "--require_ope");
    if (auto status = JsonToMessage(*report, request.mutable_offline_evaluation()); !status.ok()) {
      return Annotate(status, absl::StrCat("--require_ope: ", flags.require_ope,
                                           ": expected what spiketrain ope --json prints"));
    }
  }
  return request;
}

// Returns the name of an enumerator without its prefix, in lower case.
std::string WordOf(absl::string_view name, absl::string_view prefix) {
  return absl::AsciiStrToLower(absl::StripPrefix(name, prefix));
}

std::string StateText(const v1::Rollout& rollout) {
  return WordOf(v1::Rollout::State_Name(rollout.state()), "STATE_");
}

std::string ToText(const v1::VersionEvidence& evidence) {
  if (evidence.sessions() == 0) return "no sessions yet";
  std::string text = absl::StrFormat("%d sessions (%d with errors)", evidence.sessions(),
                                     evidence.failed_sessions());
  if (evidence.episodes() == 0) {
    absl::StrAppend(&text, ", no episode has ended");
  } else {
    absl::StrAppendFormat(&text, ", %d episodes of mean return %.4g", evidence.episodes(),
                          evidence.mean_return());
  }
  if (evidence.implausible_episodes() > 0) {
    absl::StrAppend(&text, " (and ", evidence.implausible_episodes(), " implausible ones)");
  }
  if (evidence.decisions() > 0) {
    absl::StrAppendFormat(&text, ", p99 %.3g ms", 1e3 * evidence.p99_seconds());
  }
  return text;
}

std::string ToText(const v1::RolloutCondition& condition) {
  return absl::StrFormat(
      "%s:%g%%", WordOf(v1::RolloutCondition::Measure_Name(condition.measure()), "MEASURE_"),
      100.0 * condition.margin());
}

std::string ToText(const v1::OfflineEvaluation& offline) {
  return absl::StrFormat(
      "return %.4g (%.4g to %.4g), %.4g more (%.4g to %.4g), by %.0f effective episodes of %d",
      offline.new_return(), offline.new_return_low(), offline.new_return_high(),
      offline.difference(), offline.difference_low(), offline.difference_high(),
      offline.effective_episodes(), offline.episodes());
}

std::string ToText(const v1::Rollout& rollout) {
  const std::string before = rollout.has_offline_evaluation()
                                 ? "\n  expected before: " + ToText(rollout.offline_evaluation())
                                 : "";
  return absl::StrCat(rollout.policy(), "/", rollout.version(), ": ", StateText(rollout), " at ",
                      rollout.percent(), " % (steps ", absl::StrJoin(rollout.steps(), ","), "); ",
                      rollout.reason(), "\n  ends if worse by: ",
                      absl::StrJoin(rollout.abort_if(), ",",
                                    [](std::string* out, const v1::RolloutCondition& condition) {
                                      out->append(ToText(condition));
                                    }),
                      before, "\n  version ", rollout.version(), ": ",
                      ToText(rollout.new_version_evidence()), "\n  version ",
                      rollout.stable_version(), ": ", ToText(rollout.stable_version_evidence()));
}

// Figures that nothing was measured for are null.
ordered_json ToJson(const v1::VersionEvidence& evidence) {
  ordered_json json = MessageToFields(evidence, Numbers::kExact);
  if (evidence.episodes() == 0) json["mean_return"] = json["return_deviation"] = nullptr;
  if (evidence.decisions() == 0) json["p99_seconds"] = nullptr;
  return json;
}

ordered_json ToJson(const v1::Rollout& rollout) {
  ordered_json json = MessageToFields(rollout, Numbers::kExact);
  json["state"] = StateText(rollout);
  for (ordered_json& condition : json["abort_if"]) {
    condition["measure"] = WordOf(condition["measure"].get<std::string>(), "MEASURE_");
  }
  json["new_version_evidence"] = ToJson(rollout.new_version_evidence());
  json["stable_version_evidence"] = ToJson(rollout.stable_version_evidence());
  if (rollout.has_offline_evaluation()) {
    json["offline_evaluation"] = MessageToFields(rollout.offline_evaluation());
  }
  return json;
}

template <typename Response>
absl::StatusOr<ServerAnswer> Describe(const absl::StatusOr<Response>& response) {
  if (!response.ok()) return response.status();
  return TrafficAnswer(ToText(response->rollout()), ToJson(response->rollout()),
                       response->traffic());
}

// Returns who made a change: the token and the certificate, as far as there are any, and the
// address.
std::string CallerOf(const v1::HistoryEntry& entry) {
  if (entry.address().empty()) return "the server";
  std::vector<std::string> parts;
  if (!entry.token().empty()) parts.push_back(entry.token());
  if (!entry.tenant().empty()) parts.push_back(absl::StrCat("tenant ", entry.tenant()));
  if (!entry.certificate().empty()) parts.push_back(entry.certificate());
  parts.push_back(entry.address());
  return absl::StrJoin(parts, ", ");
}

std::string ToText(const v1::HistoryEntry& entry) {
  const absl::Time time = absl::UnixEpoch() + absl::Seconds(entry.time());
  std::string text =
      absl::StrCat(absl::FormatTime("%Y-%m-%dT%H:%M:%SZ", time, absl::UTCTimeZone()), " ",
                   entry.action(), " by ", CallerOf(entry), "\n  request: ", entry.request());
  if (entry.code() != 0) return absl::StrCat(text, "\n  refused: ", entry.message());
  return absl::StrCat(text, "\n  before:  ", entry.before(), "\n  after:   ", entry.after());
}

ordered_json ToJson(const v1::HistoryEntry& entry) {
  const auto parse = [](const std::string& text) {
    auto json = ordered_json::parse(text, /*cb=*/nullptr, /*allow_exceptions=*/false);
    return json.is_discarded() ? ordered_json() : json;
  };
  ordered_json json = MessageToFields(entry, Numbers::kExact);
  for (const char* field : {"request", "before", "after"}) {
    json[field] = parse(json[field].get<std::string>());
  }
  return json;
}

}  // namespace

absl::StatusOr<ServerAnswer> ChangeRollout(const AdminFlags& flags) {
  if (flags.abort) {
    v1::AbortRolloutRequest request;
    request.set_policy(flags.policy);
    return Describe(CallAdmin(flags, &AdminStub::AbortRollout, request));
  }
  ASSIGN_OR_RETURN(const auto request, StartRequest(flags));
  return Describe(CallAdmin(flags, &AdminStub::StartRollout, request));
}

absl::StatusOr<ServerAnswer> ShowRollouts(const AdminFlags& flags) {
  ASSIGN_OR_RETURN(const auto response,
                   CallAdmin(flags, &AdminStub::ListRollouts, v1::ListRolloutsRequest()));
  std::vector<std::string> lines;
  ordered_json rollouts = ordered_json::array();
  for (const v1::Rollout& rollout : response.rollouts()) {
    lines.push_back(ToText(rollout));
    rollouts.push_back(ToJson(rollout));
  }
  return ServerAnswer{lines.empty() ? "no roll-outs" : absl::StrJoin(lines, "\n"),
                      {{"rollouts", rollouts}}};
}

absl::StatusOr<ServerAnswer> ShowHistory(const AdminFlags& flags) {
  v1::ListHistoryRequest request;
  request.set_policy(flags.policy);
  request.set_limit(flags.limit);
  ASSIGN_OR_RETURN(const auto response, CallAdmin(flags, &AdminStub::ListHistory, request));
  std::vector<std::string> lines;
  ordered_json entries = ordered_json::array();
  for (const v1::HistoryEntry& entry : response.entries()) {
    lines.push_back(ToText(entry));
    entries.push_back(ToJson(entry));
  }
  return ServerAnswer{lines.empty() ? "no actions" : absl::StrJoin(lines, "\n"),
                      {{"entries", entries}}};
}

}  // namespace spikeserve
