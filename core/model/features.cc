#include "core/model/features.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <set>
#include <utility>

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/json.h"
#include "core/base/json_object.h"
#include "core/base/printable.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

using Json = nlohmann::json;
using nlohmann::ordered_json;

constexpr size_t kLongestText = 256;  // bytes, of every text of a feature

absl::Status CheckText(absl::string_view field, absl::string_view text) {
  if (text.size() <= kLongestText && IsPrintable(text)) return absl::OkStatus();
  return InvalidArgument(field,
                         absl::StrCat("at most ", kLongestText, " bytes of printable characters"),
                         Quoted(std::string(text)));
}

absl::Status CheckNumber(absl::string_view field, const std::optional<double>& number) {
  if (!number.has_value() || std::isfinite(*number)) return absl::OkStatus();
  return InvalidArgument(field, "a finite number", *number);
}

absl::Status CheckFeature(const std::string& field, const Feature& feature) {
  if (feature.name.empty()) {
    return InvalidArgument(absl::StrCat(field, ".name"), "a name", "none");
  }
  RETURN_IF_ERROR(CheckText(absl::StrCat(field, ".name"), feature.name));
  RETURN_IF_ERROR(CheckText(absl::StrCat(field, ".unit"), feature.unit));
  RETURN_IF_ERROR(CheckText(absl::StrCat(field, ".frame"), feature.frame));
  RETURN_IF_ERROR(CheckNumber(absl::StrCat(field, ".low"), feature.low));
  RETURN_IF_ERROR(CheckNumber(absl::StrCat(field, ".high"), feature.high));
  if (!feature.low.has_value() || !feature.high.has_value() || *feature.low <= *feature.high) {
    return absl::OkStatus();
  }
  return InvalidArgument(absl::StrCat(field, ".high"), absl::StrCat("at least ", *feature.low),
                         *feature.high);
}

absl::Status CheckList(absl::string_view field, const std::vector<Feature>& features, int size) {
  if (!features.empty() && features.size() != static_cast<size_t>(size)) {
    return InvalidArgument(field, absl::StrCat("none or ", size, " elements"), features.size());
  }
  std::set<absl::string_view> names;
  for (size_t i = 0; i < features.size(); ++i) {
    const std::string element = absl::StrCat(field, "[", i, "]");
    RETURN_IF_ERROR(CheckFeature(element, features[i]));
    if (names.insert(features[i].name).second) continue;
    return InvalidArgument(absl::StrCat(element, ".name"),
                           absl::StrCat("another name than ", "before"), Quoted(features[i].name));
  }
  return absl::OkStatus();
}

ordered_json ToJson(const std::vector<Feature>& features) {
  ordered_json list = ordered_json::array();
  for (const Feature& feature : features) {
    ordered_json& object = list.emplace_back(ordered_json::object());
    object["name"] = feature.name;
    if (!feature.unit.empty()) object["unit"] = feature.unit;
    if (feature.low.has_value()) object["low"] = *feature.low;
    if (feature.high.has_value()) object["high"] = *feature.high;
    if (!feature.frame.empty()) object["frame"] = feature.frame;
  }
  return list;
}

// A quantity as the sorted list of its base units, those in the denominator with "/", and the
// factor to them.
struct Quantity {
  std::vector<std::string> bases;
  double factor = 1.0;
};

struct Atom {
  absl::string_view unit, base;
  double factor;
};
constexpr Atom kAtoms[] = {
    {"m", "m", 1.0},         {"cm", "m", 0.01},
    {"mm", "m", 0.001},      {"km", "m", 1000.0},
    {"[in_i]", "m", 0.0254}, {"[ft_i]", "m", 0.3048},
    {"rad", "rad", 1.0},     {"deg", "rad", std::numbers::pi / 180.0},
    {"s", "s", 1.0},         {"ms", "s", 0.001},
    {"us", "s", 1e-6},       {"min", "s", 60.0},
    {"h", "s", 3600.0},      {"kg", "kg", 1.0},
    {"g", "kg", 0.001},      {"N", "N", 1.0},
    {"mN", "N", 0.001},      {"kN", "N", 1000.0},
    {"A", "A", 1.0},         {"mA", "A", 0.001},
    {"V", "V", 1.0},         {"mV", "V", 0.001},
    {"Pa", "Pa", 1.0},       {"kPa", "Pa", 1000.0},
    {"bar", "Pa", 1e5},      {"1", "", 1.0},
    {"%", "", 0.01},
};

// Parses products and quotients of the atoms, each with an optional exponent of one digit.
std::optional<Quantity> ParseUnit(absl::string_view unit) {
  Quantity quantity;
  bool divides = false;
  while (true) {
    const size_t end = std::min(unit.find_first_of("./"), unit.size());
    absl::string_view part = unit.substr(0, end);
    int exponent = 1;
    if (part.size() > 1 && absl::ascii_isdigit(part.back())) {
      exponent = part.back() - '0';
      part.remove_suffix(1);
    }
    const auto* const atom = std::find_if(std::begin(kAtoms), std::end(kAtoms),
                                          [&](const Atom& any) { return any.unit == part; });
    if (atom == std::end(kAtoms)) return std::nullopt;
    for (; exponent > 0; --exponent) {
      quantity.factor = divides ? quantity.factor / atom->factor : quantity.factor * atom->factor;
      if (!atom->base.empty()) {
        quantity.bases.push_back(absl::StrCat(divides ? "/" : "", atom->base));
      }
    }
    if (end == unit.size()) break;
    divides = unit[end] == '/';
    unit.remove_prefix(end + 1);
  }
  std::sort(quantity.bases.begin(), quantity.bases.end());
  return quantity;
}

// Returns the element of `received` with the name of each expected element, or nothing if the names
// are no permutation.
std::optional<std::vector<size_t>> Permutation(absl::Span<const Feature> expected,
                                               const std::vector<std::string>& received) {
  std::vector<size_t> places;
  for (const Feature& feature : expected) {
    const auto found = std::find(received.begin(), received.end(), feature.name);
    if (found == received.end()) return std::nullopt;
    places.push_back(static_cast<size_t>(found - received.begin()));
  }
  return places;  // names of features are unique, and the lists have equal lengths
}

absl::Status CheckUnit(const ReceivedNames& received, size_t i, const Feature& feature) {
  const std::string& unit = received.units[i];
  if (unit.empty() || feature.unit.empty() || unit == feature.unit) return absl::OkStatus();
  const auto factor = UnitFactor(unit, feature.unit);
  return InvalidArgument(
      absl::StrCat(received.field, "_units[", i, "] (", feature.name, ")"), Quoted(feature.unit),
      absl::StrCat(Quoted(unit), factor.has_value()
                                     ? absl::StrCat("; multiply by ", *factor, " to convert")
                                     : ""));
}

}  // namespace

absl::Status Features::Validate(int observation_size, int action_size) const {
  RETURN_IF_ERROR(CheckList("features.observation", observation, observation_size));
  RETURN_IF_ERROR(CheckList("features.action", action, action_size));
  if (rate_hz.has_value() && !(*rate_hz > 0.0 && std::isfinite(*rate_hz))) {
    return InvalidArgument("features.rate_hz", "a positive finite number", *rate_hz);
  }
  if (rate_tolerance >= 0.0 && std::isfinite(rate_tolerance)) return absl::OkStatus();
  return InvalidArgument("features.rate_tolerance", "a finite number of at least 0",
                         rate_tolerance);
}

absl::Status ReadJson(absl::string_view field, const Json& value, Feature* feature) {
  if (value.is_string()) return ReadJson(field, value, &feature->name);
  JsonObject reader(field, value);
  reader.Required("name", &feature->name);
  reader.Optional("unit", &feature->unit);
  reader.Optional("low", &feature->low);
  reader.Optional("high", &feature->high);
  reader.Optional("frame", &feature->frame);
  return reader.Finish();
}

absl::StatusOr<Features> ParseFeatures(absl::string_view text) {
  ASSIGN_OR_RETURN(const Json object, ParseJsonObject("features", std::string(text)));
  Features features;
  JsonObject reader("features", object);
  reader.Optional("observation", &features.observation);
  reader.Optional("action", &features.action);
  reader.Optional("rate_hz", &features.rate_hz);
  reader.Optional("rate_tolerance", &features.rate_tolerance);
  RETURN_IF_ERROR(reader.Finish());
  return features;
}

std::string FormatFeatures(const Features& features) {
  ordered_json object = ordered_json::object();
  if (!features.observation.empty()) object["observation"] = ToJson(features.observation);
  if (!features.action.empty()) object["action"] = ToJson(features.action);
  if (features.rate_hz.has_value()) {
    object["rate_hz"] = *features.rate_hz;
    object["rate_tolerance"] = features.rate_tolerance;
  }
  return object.dump();
}

absl::Status CheckNames(absl::Span<const Feature> expected, const ReceivedNames& received,
                        bool in_any_order) {
  const std::string field = absl::StrCat(received.field, "_names");
  if (!received.units.empty() && received.units.size() != received.names.size()) {
    return InvalidArgument(absl::StrCat(received.field, "_units"),
                           absl::StrCat("one per name, ", received.names.size()),
                           received.units.size());
  }
  if (received.names.empty()) return absl::OkStatus();
  if (expected.empty()) {
    return InvalidArgument(field, "none, because the policy file names no elements",
                           received.names.size());
  }
  const auto append_name = [](std::string* out, const Feature& feature) {
    absl::StrAppend(out, feature.name);
  };
  if (expected.size() != received.names.size()) {
    return InvalidArgument(
        field,
        absl::StrCat(expected.size(), " names (", absl::StrJoin(expected, ", ", append_name), ")"),
        absl::StrCat(received.names.size(), " (", absl::StrJoin(received.names, ", "), ")"));
  }
  const auto places = Permutation(expected, received.names);
  for (size_t i = 0; i < expected.size(); ++i) {
    if (places.has_value() && (in_any_order || (*places)[i] == i)) continue;
    if (received.names[i] == expected[i].name) continue;
    return InvalidArgument(
        absl::StrCat(field, "[", i, "]"), Quoted(expected[i].name),
        absl::StrCat(
            Quoted(received.names[i]),
            places.has_value()
                ? absl::StrCat("; the policy's order is [", absl::StrJoin(*places, ", "),
                               "] of the received elements")
                : absl::StrCat("; the policy has ", absl::StrJoin(expected, ", ", append_name))));
  }
  for (size_t i = 0; i < expected.size() && !received.units.empty(); ++i) {
    RETURN_IF_ERROR(CheckUnit(received, (*places)[i], expected[i]));
  }
  return absl::OkStatus();
}

std::optional<double> UnitFactor(absl::string_view from, absl::string_view to) {
  const auto source = ParseUnit(from);
  const auto target = ParseUnit(to);
  if (!source.has_value() || !target.has_value() || source->bases != target->bases) {
    return std::nullopt;
  }
  return source->factor / target->factor;
}

}  // namespace spikeserve
