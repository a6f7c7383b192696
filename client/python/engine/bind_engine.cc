#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>

#include <algorithm>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/python/engine/bindings.h"
#include "client/python/engine/convert.h"

namespace spikeserve {
namespace {

namespace nb = nanobind;
using nb::literals::operator""_a;

template <typename Number>
absl::Span<const Number> View(const InputArray<Number>& array) {
  return {array.data(), array.size()};
}

std::string PathOf(const nb::object& path) {
  return nb::cast<std::string>(nb::module_::import_("os").attr("fspath")(path));
}

std::shared_ptr<PlayedPolicy> Open(const nb::object& path, const nb::object& shared_memory) {
  const std::string name = PathOf(path);
  const std::string folder = shared_memory.is_none() ? "" : PathOf(shared_memory);
  absl::StatusOr<std::shared_ptr<const PlayedPolicy>> played = nullptr;
  {
    const nb::gil_scoped_release release;
    played =
        shared_memory.is_none() ? PlayedPolicy::Read(name) : PlayedPolicy::ReadShared(name, folder);
  }
  return std::const_pointer_cast<PlayedPolicy>(ValueOrRaise(std::move(played)));
}

std::shared_ptr<LocalSession> OpenSession(std::shared_ptr<PlayedPolicy> played,
                                          std::optional<double> target_return, uint64_t seed,
                                          bool sample, std::optional<double> temperature,
                                          const nb::object& learning,
                                          const nb::object& head_delta) {
  SessionRequest request = {
      .target_return = target_return, .seed = seed, .sample = sample, .temperature = temperature};
  if (!learning.is_none()) request.learning = ToLearningRequest(learning);
  if (!head_delta.is_none()) {
    const auto delta = ToArray<float>("head_delta", head_delta, 1);
    request.head_delta =
        Eigen::Map<const Eigen::VectorXf>(delta.data(), static_cast<Eigen::Index>(delta.size()));
  }
  return ValueOrRaise(LocalSession::Open(std::move(played), std::move(request)));
}

// An executed action of a call, and the array that it refers to. The operator's name is that of the
// given object.
struct ExecutedAction {
  std::optional<ReportedAction> action;  // absent: as answered
  InputArray<float> values;
};

ExecutedAction ToExecuted(const nb::handle& given) {
  ExecutedAction executed;
  if (given.is_none()) return executed;
  if (nb::hasattr(given, "operator_id")) {  // spikeserve.Executed
    executed = ToExecuted(given.attr("action"));
    if (!executed.action.has_value()) executed.action.emplace();
    executed.action->source = {.kind = nb::cast<int>(given.attr("kind")),
                               .operator_id = nb::cast<const char*>(given.attr("operator_id"))};
    return executed;
  }
  // An array of one element converts to an integer, too, and is no index.
  if (PyIndex_Check(given.ptr()) != 0 && PySequence_Check(given.ptr()) == 0) {
    executed.action = nb::cast<int64_t>(nb::int_(given));
    return executed;
  }
  executed.values = ToArray<float>("executed_action", given, 1);
  executed.action = View(executed.values);
  return executed;
}

std::shared_ptr<LocalSession> Resume(std::shared_ptr<PlayedPolicy> played, const nb::bytes& value) {
  return ValueOrRaise(LocalSession::Resume(std::move(played), {value.c_str(), value.size()}));
}

nb::bytes Export(LocalSession& session) {
  const std::string value = session.Export();
  return nb::bytes(value.data(), value.size());
}

BoundDecision Act(LocalSession& session, nb::handle observation, double reward,
                  nb::handle executed_action) {
  const auto values = ToArray<float>("observation", observation, 1);
  const ExecutedAction executed = ToExecuted(executed_action);
  absl::StatusOr<Answer> answer = Answer();
  {
    const nb::gil_scoped_release release;
    answer = session.Act(View(values), reward, executed.action);
  }
  return ToBound(ValueOrRaise(std::move(answer)), session.policy());
}

void Skip(LocalSession& session, double reward, nb::handle executed_action) {
  const ExecutedAction executed = ToExecuted(executed_action);
  const nb::gil_scoped_release release;
  const absl::Status status = session.Skip(reward, executed.action);
  if (status.ok()) return;
  const nb::gil_scoped_acquire acquire;
  (void)ValueOrRaise(absl::StatusOr<bool>(status));
}

EpisodeSummary EndEpisode(LocalSession& session, double reward, bool terminated, bool truncated,
                          std::optional<double> target_return, nb::handle executed_action) {
  const EpisodeEnd end = {.reward = reward,
                          .terminated = terminated,
                          .target_return = target_return,
                          .truncated = truncated};
  const ExecutedAction executed = ToExecuted(executed_action);
  absl::StatusOr<EpisodeSummary> summary = EpisodeSummary();
  {
    const nb::gil_scoped_release release;
    summary = session.EndEpisode(end, executed.action);
  }
  return ValueOrRaise(std::move(summary));
}

nb::object Explain(LocalSession& session) {
  absl::StatusOr<LocalSession::Explained> explained = LocalSession::Explained();
  {
    const nb::gil_scoped_release release;
    explained = session.Explain();
  }
  return ToPython(ValueOrRaise(std::move(explained)), session.policy());
}

void CheckRows(const char* field, size_t expected, size_t received) {
  if (expected == received) return;
  throw nb::value_error(
      absl::StrCat(field, ": expected ", expected, " rows, received ", received).c_str());
}

// Returns the C++ objects of `sessions`, which live as long as their Python objects.
std::vector<LocalSession*> SessionsOf(const nb::tuple& sessions) {
  std::vector<LocalSession*> rows;
  rows.reserve(sessions.size());
  for (const nb::handle item : sessions) {
    LocalSession* session = nullptr;
    if (!nb::try_cast(item, session, /*convert=*/false) || session == nullptr) {
      const std::string type = nb::cast<std::string>(nb::str(item.type()));
      throw nb::type_error(absl::StrCat("sessions: expected sessions, received ", type).c_str());
    }
    rows.push_back(session);
  }
  return rows;
}

BoundBatch ActBatch(const PlayedPolicy& played,
                    const nb::typed<nb::sequence, LocalSession>& sequence, nb::handle observations,
                    nb::handle rewards) {
  const nb::tuple held(sequence);  // a thread may remove sessions from a list meanwhile
  const std::vector<LocalSession*> sessions = SessionsOf(held);
  const auto inputs = ToArray<float>("observations", observations, 2);
  CheckRows("observations", sessions.size(), inputs.shape(0));
  std::vector<double> earned(sessions.size());
  if (!rewards.is_none()) {
    const auto given = ToArray<double>("rewards", rewards, 1);
    CheckRows("rewards", sessions.size(), given.shape(0));
    std::copy_n(given.data(), given.size(), earned.begin());
  }
  const bool ours = std::all_of(sessions.begin(), sessions.end(), [&](const LocalSession* session) {
    return &session->played() == &played;
  });
  if (!ours) {
    throw nb::value_error("sessions: expected sessions of this engine, received another engine's");
  }
  absl::StatusOr<BatchAnswers> answers = BatchAnswers();
  {
    const nb::gil_scoped_release release;
    answers = LocalSession::ActTogether(sessions, View(inputs), earned);
  }
  return {.answers = ValueOrRaise(std::move(answers)),
          .discrete = played.policy().action_space.is_discrete(),
          .config = played.policy().config};
}

void BindSession(nb::module_& module) {
  nb::class_<LocalSession>(module, "Session",
                           "The session of one agent: its context window, return-to-go and step.")
      .def("act", &Act, "observation"_a, "reward"_a = 0.0, nb::kw_only(),
           "executed_action"_a = nb::none(),
           "Returns the decision at this step and moves to the next step.\n\n"
           "`observation` is in environment units. `reward` is for the previous action; step 0\n"
           "ignores it. `executed_action` is what was executed at the previous step; None: as\n"
           "answered. After an error the session is unchanged.")
      .def(
          "skip", &Skip, "reward"_a = 0.0, nb::kw_only(), "executed_action"_a = nb::none(),
          "Takes a step without an observation, which decides nothing: its reward counts, and the\n"
          "context begins again behind it. The arguments are those of `act`.")
      .def("end_episode", &EndEpisode, "reward"_a, "terminated"_a = false, "truncated"_a = false,
           "target_return"_a = nb::none(), nb::kw_only(), "executed_action"_a = nb::none(),
           "Takes the last reward, ends the episode and moves to step 0 of the next episode.\n\n"
           "`target_return` is for the next episode; None: the target return of the session.\n"
           "`executed_action` is the executed last action; None: as answered.")
      .def("export", &Export,
           "Returns the value of the session, with the bytes of the server's ExportSession.")
      .def("explain", &Explain,
           "Recomputes the last decision and returns its spikes, attention and gates.\n\n"
           "Takes about a thousand times as long as a decision.")
      .def("state", &StateOf, "Returns the state of the session.")
      .def_prop_ro("step", [](LocalSession& session) {
        const nb::gil_scoped_release release;
        return session.step();
      });
}

template <typename Get>
auto OfPolicy(Get get) {
  return [get](const PlayedPolicy& played) { return get(played.policy()); };
}

}  // namespace

void BindEngine(nb::module_& module) {
  BindSession(module);
  nb::class_<PlayedPolicy>(
      module, "Engine",
      "Plays one policy file in this process. Thread-safe.\n\n"
      "`shared_memory` is a folder, such as /dev/shm/policies. The processes\n"
      "of this user that name it have the weight matrices of a policy once in\n"
      "memory. Only this user may write the folder.\n\n"
      "ValueError or FileNotFoundError if the file is not a valid policy.")
      .def(nb::new_(&Open), "path"_a, nb::kw_only(), "shared_memory"_a = nb::none())
      .def("session", &OpenSession, nb::kw_only(), "target_return"_a = nb::none(), "seed"_a = 0,
           "sample"_a = false, "temperature"_a = nb::none(), "learning"_a = nb::none(),
           "head_delta"_a = nb::none(),
           "Opens a session. None selects the default of the policy.\n\n"
           "`learning` is a Learning of this package or of the client.")
      .def("resume", &Resume, "value"_a,
           "Continues a session from its value, bit for bit, that a server has exported.\n\n"
           "The engine has to play the same policy file. ValueError if the value is damaged.")
      .def("act_batch", &ActBatch, "sessions"_a, "observations"_a, "rewards"_a = nb::none(),
           "Decides for different sessions of this engine at once, as `act` does for each.\n\n"
           "observations: [rows, observation_size]; rewards: [rows], None: all 0. After an error,\n"
           "which names the row, no session has changed.")
      .def_prop_ro("observation_size",
                   OfPolicy([](const Policy& p) { return p.observation_size(); }))
      .def_prop_ro("action_space",
                   OfPolicy([](const Policy& p) { return ToPython(p.action_space); }))
      .def_prop_ro("context_length", OfPolicy([](const Policy& p) { return p.config.context; }))
      .def_prop_ro("target_return", OfPolicy([](const Policy& p) { return p.target_return; }))
      .def_prop_ro("training_return", OfPolicy([](const Policy& p) { return TrainingReturn(p); }))
      .def_prop_ro("environment", OfPolicy([](const Policy& p) { return p.environment; }))
      .def_prop_ro("mode",
                   OfPolicy([](const Policy& p) { return std::string(ToString(p.config.mode)); }))
      .def_prop_ro("arithmetic", OfPolicy([](const Policy& p) {
                     return std::string(ToString(p.config.arithmetic));
                   }))
      .def_prop_ro("training", OfPolicy([](const Policy& p) { return p.training; }),
                   "The record of the training, as JSON.");
}

}  // namespace spikeserve
