#include "train/model/surrogate.h"

#include "absl/strings/str_cat.h"

namespace spikeserve {

absl::StatusOr<SurrogateKind> ParseSurrogateKind(absl::string_view name) {
  if (name == "fast_sigmoid") return SurrogateKind::kFastSigmoid;
  if (name == "sigmoid") return SurrogateKind::kSigmoid;
  if (name == "piecewise_linear") return SurrogateKind::kPiecewiseLinear;
  return absl::InvalidArgumentError(absl::StrCat(
      "surrogate: expected fast_sigmoid, sigmoid or piecewise_linear, got '", name, "'"));
}

std::string_view ToString(SurrogateKind kind) {
  switch (kind) {
    case SurrogateKind::kFastSigmoid:
      return "fast_sigmoid";
    case SurrogateKind::kSigmoid:
      return "sigmoid";
    case SurrogateKind::kPiecewiseLinear:
      return "piecewise_linear";
  }
  return "";
}

}  // namespace spikeserve
