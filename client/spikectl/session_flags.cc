#include "client/spikectl/session_flags.h"

#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "absl/strings/strip.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/learning/learning_request.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

constexpr char kLearning[] = "Advanced: learning";

bool AnySet(const LearningFlags& flags) {
  return flags.rule || flags.modulator || flags.learning_rate || flags.trace_decay ||
         flags.discount || flags.clip || flags.max_drift || flags.guard_margin ||
         flags.verdict_seconds;
}

v1::Durability ToProto(Durability durability) {
  switch (durability) {
    case Durability::kNone:
      return v1::NONE;
    case Durability::kAsync:
      return v1::ASYNC;
    case Durability::kSync:
      return v1::SYNC;
  }
  return v1::DURABILITY_DEFAULT;  // unreachable: the switch handles every level
}

// Reads W - W_base from a file: a list of numbers, or an object with such a list as `delta` or
// `head_delta`, as `spikectl admin head --weights --json` prints it.
absl::Status ReadHeadDelta(const std::string& path, v1::OpenSessionRequest* request) {
  const auto text = ReadFile(path);
  if (!text.ok()) return absl::NotFoundError(absl::StrCat("--head_delta: cannot read ", path));
  nlohmann::json json = nlohmann::json::parse(*text, nullptr, /*allow_exceptions=*/false);
  for (const char* key : {"delta", "head_delta"}) {
    if (json.is_object() && json.contains(key)) json = nlohmann::json(json[key]);
  }
  const auto refuse = [&] {
    return absl::InvalidArgumentError(absl::StrCat(
        "--head_delta: expected a list of numbers, or an object with one as \"delta\", in ", path));
  };
  if (!json.is_array()) return refuse();
  for (const nlohmann::json& number : json) {
    if (!number.is_number()) return refuse();
    request->add_head_delta(number.get<float>());
  }
  return absl::OkStatus();
}

}  // namespace

void AddLearningFlags(Command command, LearningFlags* flags) {
  FlagGroup group = command.Flags(kLearning);
  group
      .Add("rule", EnumKind<Rule>(), &flags->rule,
           "Learning rule; corrections: operators teach; default: policy_gradient")
      .Add("modulator", EnumKind<Modulator>(), &flags->modulator,
           "Return that modulates it; default: realized")
      .Add("learning_rate", "RATE", &flags->learning_rate,
           "Learning rate; default: the server's for the rule and the modulator")
      .Add("trace_decay", "FACTOR", &flags->trace_decay,
           "Decay of the eligibility trace per decision; default: the server's")
      .Add("discount", "FACTOR", &flags->discount,
           "Discount of the realized return; default: the server's default")
      .Add("clip", "NORM", &flags->clip, "Largest norm of one update; default: the server's")
      .Add("max_drift", "RATIO", &flags->max_drift,
           "Largest drift of a private head; default: the server's")
      .Add("guard_margin", "FRACTION", &flags->guard_margin,
           "Margin of the guard of a private head; default: the server's")
      .Add("verdict_seconds", "SECONDS", &flags->verdict_seconds,
           "How long an ended episode waits for its verdict; default: 0");
}

void AddSessionFlags(Command command, SessionFlags* flags) {
  command.Flags("Session")
      .AddSwitch("sample", &flags->sample, "Sample the actions, instead of the most probable ones")
      .Add("temperature", "T", &flags->temperature, "Sampling temperature; default: 1")
      .Add("version_label", "NAME", &flags->version_label,
           "Version by its label, such as canary; not with --version")
      .Add("routing_key", "KEY", &flags->routing_key,
           "Key that decides the traffic share; equal keys get equal versions")
      .AddList("labels", "KEY=VALUE,...", &flags->labels, "Labels of the session")
      .AddSwitch("record", &flags->record, "Have the server record it in its --record_dir")
      .Add("learn", EnumKind<Scope>(), &flags->learn, "Head that learns; default: none")
      .Add("durability", EnumKind<Durability>(), &flags->durability,
           "What survives the loss of a server; default: the server's");
  AddLearningFlags(command, &flags->learning);
  command.Flags(kLearning).Add("head_delta", "FILE", &flags->head_delta,
                               "Head to start from: the JSON of admin head --weights");
}

v1::LearningConfig ToProto(Scope scope, const LearningFlags& flags) {
  v1::LearningConfig config;
  if (scope == Scope::kFleet) config.set_scope(v1::LearningConfig::FLEET);
  if (flags.rule) config.set_rule(std::string(ToString(*flags.rule)));
  if (flags.modulator) config.set_modulator(std::string(ToString(*flags.modulator)));
  if (flags.learning_rate) config.set_learning_rate(*flags.learning_rate);
  if (flags.trace_decay) config.set_trace_decay(*flags.trace_decay);
  if (flags.discount) config.set_discount(*flags.discount);
  if (flags.clip) config.set_clip(*flags.clip);
  if (flags.max_drift) config.set_max_drift(*flags.max_drift);
  if (flags.guard_margin) config.set_guard_margin(*flags.guard_margin);
  if (flags.verdict_seconds) config.set_verdict_seconds(*flags.verdict_seconds);
  return config;
}

absl::Status CheckLearning(Scope scope, const LearningFlags& flags, const ActionSpace& space,
                           const ActionSelection& selection) {
  const LearningRequest request = {
      .scope = scope,
      .rule = flags.rule ? std::string(ToString(*flags.rule)) : "",
      .modulator = flags.modulator ? std::string(ToString(*flags.modulator)) : "",
      .learning_rate = flags.learning_rate,
      .trace_decay = flags.trace_decay,
      .discount = flags.discount,
      .clip = flags.clip,
      .max_drift = flags.max_drift,
      .guard_margin = flags.guard_margin,
      .verdict_seconds = flags.verdict_seconds};
  const absl::Status status = ResolveLearning(request, space, selection).status();
  if (status.ok()) return status;
  return absl::InvalidArgumentError(
      absl::StrCat("--", absl::StripPrefix(status.message(), "learning.")));
}

absl::Status AddLabels(absl::string_view flag, const std::vector<std::string>& texts,
                       google::protobuf::Map<std::string, std::string>* labels) {
  for (const std::string& text : texts) {
    const std::vector<std::string> parts = absl::StrSplit(text, absl::MaxSplits('=', 1));
    if (parts.size() != 2) {
      return InvalidArgument(flag, "KEY=VALUE", absl::StrCat("\"", text, "\""));
    }
    (*labels)[parts[0]] = parts[1];
  }
  return absl::OkStatus();
}

absl::Status FillRequest(const SessionFlags& flags, v1::OpenSessionRequest* request) {
  if (!flags.learn && AnySet(flags.learning)) {
    return InvalidArgument("--learn", "session or fleet with flags of the learning", "none");
  }
  if (flags.temperature && !flags.sample) {
    return InvalidArgument("--temperature", "--sample with it", *flags.temperature);
  }
  if (flags.learn) *request->mutable_learning() = ToProto(*flags.learn, flags.learning);
  if (flags.sample) request->set_action_selection(v1::SAMPLE);
  if (flags.temperature) request->set_temperature(*flags.temperature);
  request->set_version_label(flags.version_label);
  request->set_routing_key(flags.routing_key);
  request->set_record(flags.record);
  if (flags.durability) request->set_durability(ToProto(*flags.durability));
  RETURN_IF_ERROR(AddLabels("--labels", flags.labels, request->mutable_labels()));
  return flags.head_delta.empty() ? absl::OkStatus() : ReadHeadDelta(flags.head_delta, request);
}

}  // namespace spikeserve
