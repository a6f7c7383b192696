#include "core/model/config.h"

#include <cmath>
#include <string>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/string_view.h"
#include "core/base/json.h"

namespace spikeserve {
namespace {

template <typename Enum>
struct Named {
  Enum value;
  std::string_view name;
};

constexpr Named<Mode> kModes[] = {{Mode::kBaseline, "baseline"},
                                  {Mode::kPos, "pos"},
                                  {Mode::kRoute, "route"},
                                  {Mode::kFull, "full"},
                                  {Mode::kDense, "dense"}};
constexpr Named<CoderKind> kCoders[] = {{CoderKind::kLif, "lif"},
                                        {CoderKind::kBernoulli, "bernoulli"}};
constexpr Named<PhaseClock> kPhaseClocks[] = {{PhaseClock::kTimestep, "timestep"},
                                              {PhaseClock::kWindow, "window"}};
constexpr Named<Merge> kMerges[] = {{Merge::kSum, "sum"}, {Merge::kConcat, "concat"}};
constexpr Named<Gate> kGates[] = {{Gate::kSoftmax, "softmax"}, {Gate::kSigmoid, "sigmoid"}};

template <typename Enum, size_t size>
std::string_view NameOf(const Named<Enum> (&names)[size], Enum value) {
  for (const auto& entry : names) {
    if (entry.value == value) return entry.name;
  }
  return "invalid";
}

template <typename Enum, size_t size>
absl::StatusOr<Enum> ValueOf(const Named<Enum> (&names)[size], absl::string_view field,
                             std::string_view name) {
  for (const auto& entry : names) {
    if (entry.name == name) return entry.value;
  }
  const auto append_name = [](std::string* out, const Named<Enum>& entry) {
    absl::StrAppend(out, "\"", std::string(entry.name), "\"");
  };
  return absl::InvalidArgumentError(absl::StrCat(field, ": expected one of ",
                                                 absl::StrJoin(names, ", ", append_name), ", got ",
                                                 Quoted(std::string(name))));
}

absl::Status CheckRange(absl::string_view field, int value, int limit) {
  if (value >= 1 && value <= limit) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat(field, ": expected 1 to ", limit, ", got ", value));
}

}  // namespace

std::string_view ToString(Mode mode) { return NameOf(kModes, mode); }
std::string_view ToString(CoderKind coder) { return NameOf(kCoders, coder); }
std::string_view ToString(PhaseClock clock) { return NameOf(kPhaseClocks, clock); }
std::string_view ToString(Merge merge) { return NameOf(kMerges, merge); }
std::string_view ToString(Gate gate) { return NameOf(kGates, gate); }

absl::StatusOr<Mode> ParseMode(std::string_view name) { return ValueOf(kModes, "mode", name); }
absl::StatusOr<CoderKind> ParseCoderKind(std::string_view name) {
  return ValueOf(kCoders, "coder", name);
}
absl::StatusOr<PhaseClock> ParsePhaseClock(std::string_view name) {
  return ValueOf(kPhaseClocks, "phase_clock", name);
}
absl::StatusOr<Merge> ParseMerge(std::string_view name) { return ValueOf(kMerges, "merge", name); }
absl::StatusOr<Gate> ParseGate(std::string_view name) { return ValueOf(kGates, "gate", name); }

absl::Status ModelConfig::Validate() const {
  absl::Status status;
  status.Update(CheckRange("hidden_size", hidden_size, ModelLimits::kHiddenSize));
  status.Update(CheckRange("heads", heads, ModelLimits::kHeads));
  status.Update(CheckRange("layers", layers, ModelLimits::kLayers));
  status.Update(CheckRange("ticks", ticks, ModelLimits::kTicks));
  status.Update(CheckRange("context", context, ModelLimits::kContext));
  status.Update(
      CheckRange("routing_hidden_size", routing_hidden_size, ModelLimits::kRoutingHiddenSize));
  status.Update(CheckRange("ffn_size", ffn_size, ModelLimits::kFfnSize));
  if (!status.ok()) return status;
  if (hidden_size % heads != 0) {
    return absl::InvalidArgumentError(
        absl::StrCat("hidden_size: expected a multiple of heads = ", heads, ", got ", hidden_size));
  }
  if (!(membrane_decay >= 0.0f && membrane_decay <= 1.0f)) {
    return absl::InvalidArgumentError(
        absl::StrCat("membrane_decay: expected 0 to 1, got ", membrane_decay));
  }
  if (!(threshold > 0.0f && std::isfinite(threshold))) {
    return absl::InvalidArgumentError(
        absl::StrCat("threshold: expected a positive finite number, got ", threshold));
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
