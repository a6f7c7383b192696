#include "core/environment/perturbation.h"

#include <cmath>
#include <functional>
#include <utility>
#include <vector>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/environment/classic_tasks.h"
#include "core/environment/position_only.h"

namespace spikeserve {
namespace {

// The effect of one perturbation on the constants of a task.
template <typename Parameters>
struct Change {
  const char* name;
  std::function<void(Parameters&, double)> apply;
};

template <auto MakeTask, typename Parameters>
absl::StatusOr<std::unique_ptr<Environment>> Make(absl::string_view id,
                                                  const Perturbation& perturbation,
                                                  const std::vector<Change<Parameters>>& changes) {
  for (const Change<Parameters>& change : changes) {
    if (change.name != perturbation.name) continue;
    Parameters parameters;
    change.apply(parameters, perturbation.value);
    return MakeTask(parameters);
  }
  const std::string names = absl::StrJoin(
      changes, ", ", [](std::string* out, const auto& change) { out->append(change.name); });
  return InvalidArgument("perturb", absl::StrCat("one of ", names, " for ", std::string(id)),
                         absl::StrCat("\"", perturbation.name, "\""));
}

absl::StatusOr<std::unique_ptr<Environment>> PerturbedAcrobot(absl::string_view id,
                                                              const Perturbation& perturbation) {
  using P = AcrobotParameters;
  return Make<MakeAcrobot, P>(id, perturbation,
                              {{"length",
                                [](P& p, double factor) {
                                  for (double* length : {&p.l1, &p.lc1, &p.lc2}) *length *= factor;
                                  for (double* inertia : {&p.i1, &p.i2})
                                    *inertia *= factor * factor;
                                }},
                               {"mass",
                                [](P& p, double factor) {
                                  for (double* mass : {&p.m1, &p.m2, &p.i1, &p.i2}) *mass *= factor;
                                }},
                               {"force", [](P& p, double factor) { p.torque *= factor; }},
                               {"gravity", [](P& p, double factor) { p.gravity *= factor; }}});
}

}  // namespace

absl::StatusOr<Perturbation> ParsePerturbation(absl::string_view text) {
  const size_t equals = text.find('=');
  Perturbation perturbation = {.name = std::string(text.substr(0, equals))};
  const std::string value(equals == text.npos ? "" : text.substr(equals + 1));
  if (!absl::SimpleAtod(value, &perturbation.value) || !std::isfinite(perturbation.value)) {
    return InvalidArgument("perturb", "NAME=VALUE with a finite number",
                           absl::StrCat("\"", std::string(text), "\""));
  }
  return perturbation;
}

absl::StatusOr<std::unique_ptr<Environment>> MakePerturbedEnvironment(
    absl::string_view id, const Perturbation& perturbation) {
  const bool is_size = perturbation.name == "length" || perturbation.name == "mass";
  if (is_size && perturbation.value <= 0.0) {
    return InvalidArgument("perturb", absl::StrCat("a ", perturbation.name, " above 0"),
                           perturbation.value);
  }
  if (id == kCartPoleId) {
    using P = CartPoleParameters;
    return Make<MakeCartPole, P>(
        id, perturbation,
        {{"wind", [](P& p, double newtons) { p.wind = newtons; }},
         {"length", [](P& p, double factor) { p.half_length *= factor; }},
         {"mass", [](P& p, double factor) { p.cart_mass *= factor, p.pole_mass *= factor; }},
         {"force", [](P& p, double factor) { p.force *= factor; }},
         {"gravity", [](P& p, double factor) { p.gravity *= factor; }}});
  }
  if (id == kMountainCarId) {
    using P = MountainCarParameters;
    return Make<MakeMountainCar, P>(
        id, perturbation,
        {{"force", [](P& p, double factor) { p.force *= factor; }},
         {"gravity", [](P& p, double factor) { p.gravity *= factor; }}});
  }
  if (id == kAcrobotId) return PerturbedAcrobot(id, perturbation);
  if (id == kPendulumId) {
    using P = PendulumParameters;
    return Make<MakePendulum, P>(id, perturbation,
                                 {{"length", [](P& p, double factor) { p.length *= factor; }},
                                  {"mass", [](P& p, double factor) { p.mass *= factor; }},
                                  {"force", [](P& p, double factor) { p.force *= factor; }},
                                  {"gravity", [](P& p, double factor) { p.gravity *= factor; }}});
  }
  const absl::string_view inside_id = PositionOnly::InsideId(id);
  if (inside_id != id) {
    ASSIGN_OR_RETURN(auto inside, MakePerturbedEnvironment(inside_id, perturbation));
    return PositionOnly::Wrap(id, std::move(inside));
  }
  RETURN_IF_ERROR(MakeEnvironment(id).status());  // NOT_FOUND, with the known ids
  return InvalidArgument("perturb", absl::StrCat("no perturbation of ", std::string(id)),
                         absl::StrCat("\"", perturbation.name, "\""));
}

}  // namespace spikeserve
