// The Python module spikeserve._robot: the robot's end of a session (core/robot) for
// spikeserve.piloting, which has the threads and calls around it, and the lock of each session.
//
// Times are nanoseconds, `now` by the monotonic and then by the robot's clock. An action is an int
// for a Discrete space, and an array of float32 numbers for a Box.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/string_view.h>
#include <nanobind/stl/variant.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <chrono>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <variant>
#include <vector>

#include "client/python/robot/request_fields.h"
#include "core/robot/robot_session.h"

namespace spikeserve::robot {
namespace {

namespace nb = nanobind;
using nb::literals::operator""_a;

using Numbers = nb::ndarray<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using GivenAction = std::variant<int64_t, Numbers>;
using Nanoseconds = int64_t;

std::span<const float> ViewOf(const Numbers& numbers) { return {numbers.data(), numbers.size()}; }

ActionView ViewOf(const GivenAction& action) {
  const int64_t* const index = std::get_if<int64_t>(&action);
  if (index != nullptr) return {.discrete = *index};
  return {.discrete = -1, .continuous = ViewOf(std::get<Numbers>(action))};  // no index
}

// An action of the caller that may be absent.
class MaybeAction {
 public:
  explicit MaybeAction(const std::optional<GivenAction>& action)
      : is_given_(action.has_value()), view_(is_given_ ? ViewOf(*action) : ActionView()) {}
  const ActionView* get() const { return is_given_ ? &view_ : nullptr; }

 private:
  const bool is_given_;
  const ActionView view_;
};

// The number of v1::ActionSource::Kind, and the name of an operator.
using GivenSource = std::pair<int64_t, std::string_view>;

ChooserView ViewOf(const GivenSource& source) {
  return {.kind = static_cast<Chooser>(source.first), .operator_id = source.second};
}

Now NowOf(Nanoseconds steady, Nanoseconds robot) { return {Time(steady), Time(robot)}; }

// Returns bytes that NumPy reads, and the caller may change.
nb::object BytesOf(std::span<const float> values) {
  return nb::steal(PyByteArray_FromStringAndSize(reinterpret_cast<const char*>(values.data()),
                                                 static_cast<Py_ssize_t>(values.size_bytes())));
}

nb::object ToPython(const ActionView& action, const ActionShape& shape) {
  return shape.is_box() ? BytesOf(action.continuous) : nb::cast(action.discrete);
}

RobotSession MakeSession(const nb::kwargs& given, const GivenAction& neutral) {
  const auto time = [&](const char* name) { return Time(nb::cast<Nanoseconds>(given[name])); };
  const auto count = [&](const char* name) { return nb::cast<size_t>(given[name]); };
  const ActionShape shape(nb::cast<int64_t>(given["n"]), nb::cast<std::vector<float>>(given["low"]),
                          nb::cast<std::vector<float>>(given["high"]));
  Settings settings = {.observation_size = count("observation_size"),
                       .period = time("period"),
                       .oldest = time("oldest"),
                       .oldest_held = time("oldest_held"),
                       .hold_steps = nb::cast<int>(given["hold_steps"]),
                       .ramp_steps = nb::cast<int>(given["ramp_steps"]),
                       .most_in_flight = count("most_in_flight"),
                       .kept_steps = count("kept_steps"),
                       .servers = count("servers"),
                       .has_engine = nb::cast<bool>(given["has_engine"]),
                       .shares_head = nb::cast<bool>(given["shares_head"]),
                       .sends_datagrams = nb::cast<bool>(given["sends_datagrams"]),
                       .redundancy = nb::cast<int>(given["redundancy"])};
  if (!shape.Fit(ViewOf(neutral), &settings.neutral)) {
    const std::string received = nb::cast<std::string>(given["neutral_text"]);
    throw nb::value_error(
        ("neutral: expected an action of the policy's action space, received " + received).c_str());
  }
  const Opening opening = {.history_limit = nb::cast<int64_t>(given["history_limit"]),
                           .is_stored = nb::cast<bool>(given["is_stored"])};
  return RobotSession(settings, shape, opening, {time("steady"), time("robot")});
}

bool BeginStep(RobotSession& session, const Numbers& observation, double reward,
               const std::optional<GivenAction>& executed, const GivenSource& source,
               std::string_view traceparent, Nanoseconds steady, Nanoseconds robot) {
  const MaybeAction action(executed);
  return session.BeginStep({.observation = ViewOf(observation),
                            .reward = reward,
                            .executed = action.get(),
                            .chooser = ViewOf(source),
                            .traceparent = traceparent},
                           NowOf(steady, robot));
}

// Returns the action, its source, and its age in seconds.
nb::tuple FinishStep(RobotSession& session, Nanoseconds steady, Nanoseconds robot) {
  const StepResult result = session.FinishStep(NowOf(steady, robot));
  return nb::make_tuple(ToPython(result.action, session.step_log().shape()),
                        SourceName(result.source), SecondsOf(result.age));
}

std::optional<uint64_t> EndEpisode(RobotSession& session, double reward, bool terminated,
                                   bool truncated, std::optional<double> target_return,
                                   const std::optional<Numbers>& observation,
                                   const std::optional<GivenAction>& executed,
                                   const GivenSource& source) {
  Outcome outcome = {.reward = reward,
                     .terminated = terminated,
                     .truncated = truncated,
                     .target_return = target_return};
  if (observation.has_value()) {
    const std::span<const float> values = ViewOf(*observation);
    outcome.observation.assign(values.begin(), values.end());
  }
  return session.EndEpisode(std::move(outcome), MaybeAction(executed).get(), ViewOf(source));
}

// Returns the serial number of an episode, and what its EpisodeSummary has of the robot.
nb::object ToPython(const std::optional<Settled>& settled) {
  if (!settled.has_value()) return nb::none();
  nb::dict own;
  own["steps"] = settled->steps;
  own["lost_steps"] = settled->lost_steps;
  own["episode_return"] = settled->episode_return;
  return nb::make_tuple(settled->serial, own);
}

// `datagram` is the number of the request, None on the stream. Returns the episode that has ended
// or None, and whether there is work.
nb::tuple OnReply(RobotSession& session, std::optional<uint64_t> datagram, const Error* error,
                  int64_t next_step, const std::optional<GivenAction>& action,
                  const GivenSource& source, Nanoseconds observed_at, bool stays_safe,
                  uint64_t durable_decision, int64_t durable_episode, bool has_ended,
                  std::optional<double> episode_return, Nanoseconds steady, Nanoseconds robot) {
  Reply reply = {.error = error,
                 .next_step = next_step,
                 .chooser = ViewOf(source),
                 .observed_at = Time(observed_at),
                 .stays_safe = stays_safe,
                 .durable_decision = durable_decision,
                 .durable_episode = durable_episode,
                 .has_ended = has_ended,
                 .episode_return = episode_return};
  if (action.has_value()) reply.action = ViewOf(*action);
  const Now now = NowOf(steady, robot);
  const Received received = datagram.has_value() ? session.OnDatagram(*datagram, reply, now)
                                                 : session.OnReply(reply, now);
  return nb::make_tuple(ToPython(received.settled), received.has_work);
}

// A task with a copy of its request.
struct BoundTask {
  Task task;
  nb::object request;
};

BoundTask Bind(const RobotSession& session, Task task) {
  BoundTask bound = {std::move(task), nb::none()};
  if (bound.task.kind == Task::Kind::kSend) {
    bound.request = FieldsOf(session.step_log(), bound.task.request);
  }
  bound.task.request = {};  // its views end with the lock
  return bound;
}

BoundTask Next(RobotSession& session, Nanoseconds now) {
  return Bind(session, session.Next(Time(now)));
}

std::optional<BoundTask> NextSend(RobotSession& session, Nanoseconds now) {
  std::optional<Task> task = session.NextSend(Time(now));
  if (!task.has_value()) return std::nullopt;
  return Bind(session, *std::move(task));
}

// Returns what the robot's engine plays: the end of an episode, or a step.
nb::dict WorkOf(const RobotSession& session) {
  const LocalWork& work = session.work();
  nb::dict fields;
  fields["is_end"] = work.is_end;
  fields["step"] = work.step;
  fields["executed"] =
      work.has_executed ? ToPython(work.executed.view(), session.step_log().shape()) : nb::none();
  fields["source"] = static_cast<int>(work.chooser.kind);
  fields["operator_id"] = work.chooser.operator_id;
  if (!work.is_end) {
    fields["observation"] = BytesOf(work.observation);
    fields["reward"] = work.reward;
    return fields;
  }
  fields["reward"] = work.outcome.reward;
  fields["terminated"] = work.outcome.terminated;
  fields["truncated"] = work.outcome.truncated;
  fields["target_return"] = work.outcome.target_return;
  return fields;
}

// Returns the fields of PilotStats.
nb::dict StatsOf(const RobotSession& session, Nanoseconds now) {
  const Counts& counts = session.counters().counts();
  const Ages& ages = session.counters().ages();
  const InvalidObservation& invalid = session.invalid_observation();
  nb::dict stats, entries;
  for (size_t i = 0; i < kSources; ++i) {
    const char* const source = SourceName(static_cast<Source>(i)).data();
    stats[source] = counts.by_source[i];
    entries[source] = session.fallback().entries()[i];
  }
  stats["beats"] = counts.steps;
  stats["entries"] = entries;
  stats["stale"] = counts.stale;
  stats["late_answers"] = counts.late_answers;
  stats["cancelled_calls"] = counts.cancelled_requests;
  stats["datagram_answers"] = counts.datagram_answers;
  stats["sends_datagrams"] = session.SendsDatagrams(Time(now));
  stats["reconnects"] = counts.reconnects;
  stats["reopened"] = counts.reopened;
  stats["dropped"] = session.step_log().dropped();
  stats["lost_episodes"] = session.step_log().lost_episodes();
  stats["unequal_returns"] = counts.unequal_returns;
  stats["invalid"] = counts.invalid;
  stats["invalid_observations"] = counts.invalid_observations;
  stats["last_invalid_observation"] = invalid.expected > 0 ? invalid.ToString() : "";
  stats["failures"] = counts.failures;
  stats["longest_gap"] = SecondsOf(counts.longest_gap);
  stats["age_p50"] = SecondsOf(ages.Quantile(0.5));
  stats["age_p99"] = SecondsOf(ages.Quantile(0.99));
  stats["age_p999"] = SecondsOf(ages.Quantile(0.999));
  stats["has_local"] = session.local().is_ready();
  stats["local_head_is_copy"] = session.local().is_ready() && session.shares_head();
  stats["stays_safe"] = session.stays_safe();
  return stats;
}

void BindEvents(nb::module_& module) {
  nb::enum_<Choice>(module, "Choice")
      .value("TAKEN", Choice::kTaken)
      .value("WAIT", Choice::kWait)
      .value("OWN_ACTION", Choice::kOwnAction);
  nb::enum_<Failure>(module, "Failure")
      .value("NOT_FOUND", Failure::kNotFound)
      .value("CONFLICT", Failure::kConflict)
      .value("INVALID", Failure::kInvalid)
      .value("AWAY", Failure::kAway)
      .value("OTHER", Failure::kOther);
  nb::class_<Error>(module, "Error")
      .def(
          "__init__",
          [](Error* error, Failure kind, std::string message, std::string text,
             std::optional<uint64_t> decision, std::optional<int64_t> episode,
             std::optional<double> retry_after) {
            new (error) Error{.kind = kind,
                              .message = std::move(message),
                              .text = std::move(text),
                              .expected_decision = decision,
                              .expected_episode = episode};
            if (!retry_after.has_value()) return;
            const std::chrono::duration<double> longest = kNever / 2;  // a sum would overflow
            error->retry_after = std::chrono::duration_cast<Time>(
                std::min(longest, std::chrono::duration<double>(*retry_after)));
          },
          "kind"_a, "message"_a, "text"_a, "expected_decision"_a = nb::none(),
          "expected_episode"_a = nb::none(), "retry_after"_a = nb::none());
  nb::enum_<Task::Kind>(module, "Kind")
      .value("WAIT", Task::Kind::kWait)
      .value("FORGET", Task::Kind::kForget)
      .value("SEND", Task::Kind::kSend)
      .value("PLAY", Task::Kind::kPlay)
      .value("OPEN_SESSION", Task::Kind::kOpenSession)
      .value("OPEN_STREAM", Task::Kind::kOpenStream)
      .value("CLOSE_STREAM", Task::Kind::kCloseStream)
      .value("DOUBT_LINE", Task::Kind::kDoubtLine)
      .value("EXPORT_SESSION", Task::Kind::kExportSession)
      .value("END_EPISODE", Task::Kind::kEndEpisode)
      .value("STOP", Task::Kind::kStop);
  nb::class_<BoundTask>(module, "Task")
      .def_prop_ro("kind", [](const BoundTask& bound) { return bound.task.kind; })
      .def_prop_ro("time", [](const BoundTask& bound) { return bound.task.time.count(); })
      .def_ro("request", &BoundTask::request)
      .def_prop_ro("by_stream", [](const BoundTask& bound) { return bound.task.ways.stream; })
      .def_prop_ro(
          "copies",
          [](const BoundTask& bound) { return bound.task.ways.datagram ? bound.task.copies : 0; })
      .def_prop_ro("datagram", [](const BoundTask& bound) { return bound.task.datagram; })
      .def_prop_ro("serial", [](const BoundTask& bound) { return bound.task.serial; })
      .def_prop_ro("reason", [](const BoundTask& bound) { return bound.task.reason; });
}

void BindControlStep(nb::class_<RobotSession>& session) {
  session
      .def("__init__",
           [](RobotSession* self, const GivenAction& neutral, const nb::kwargs& settings) {
             new (self) RobotSession(MakeSession(settings, neutral));
           })
      .def("begin_step", &BeginStep, "observation"_a, "reward"_a, "executed"_a.none(), "source"_a,
           "traceparent"_a, "steady"_a, "robot"_a)
      .def("choose",
           [](RobotSession& self, Nanoseconds steady, Nanoseconds robot, Nanoseconds deadline) {
             return self.Choose(NowOf(steady, robot), Time(deadline));
           })
      .def(
          "take_own",
          [](RobotSession& self, const std::optional<GivenAction>& action) {
            self.TakeOwn(MaybeAction(action).get());
          },
          "action"_a.none())
      .def("finish_step", &FinishStep)
      .def("end_episode", &EndEpisode, "reward"_a, "terminated"_a, "truncated"_a,
           "target_return"_a.none(), "observation"_a.none(), "executed"_a.none(), "source"_a)
      .def("has_answer", &RobotSession::HasAnswer)
      .def("ask_again", [](RobotSession& self, Nanoseconds steady,
                           Nanoseconds robot) { self.AskAgain(NowOf(steady, robot)); })
      .def("sees", &RobotSession::sees)
      .def("invalid_observation",
           [](const RobotSession& self) { return self.invalid_observation().ToString(); })
      .def("running_steps",
           [](const RobotSession& self) { return self.step_log().running().steps; })
      .def("lost_steps",
           [](const RobotSession& self) { return self.step_log().running().lost_steps; })
      .def("stats", &StatsOf);
}

void BindLink(nb::class_<RobotSession>& session) {
  session.def("close", [](RobotSession& self, Nanoseconds at) { self.Close(Time(at)); })
      .def("next", &Next)
      .def("next_send", &NextSend)
      .def("end_fields", [](const RobotSession& self) { return EndFieldsOf(self.step_log()); })
      .def("work", &WorkOf)
      .def("is_calling", [](const RobotSession& self) { return self.call() != CallState::kNone; })
      .def("has_denied", &RobotSession::HasDenied)
      .def("on_stream_opened", &RobotSession::OnStreamOpened)
      .def("on_channel", [](RobotSession& self, Nanoseconds until) { self.OnChannel(Time(until)); })
      .def("on_reply", &OnReply, "datagram"_a.none(), "error"_a.none(), "next_step"_a,
           "action"_a.none(), "source"_a, "observed_at"_a, "stays_safe"_a, "durable_decision"_a,
           "durable_episode"_a, "has_ended"_a, "episode_return"_a.none(), "steady"_a, "robot"_a)
      .def("on_stream_ended", &RobotSession::OnStreamEnded)
      .def("on_stream_closed",
           [](RobotSession& self, bool is_renewed, Nanoseconds now) {
             return self.OnStreamClosed(is_renewed, Time(now));
           })
      .def("on_opened",
           [](RobotSession& self, int64_t history_limit, bool is_stored) {
             self.OnOpened({.history_limit = history_limit, .is_stored = is_stored});
           })
      .def("on_exported",
           [](RobotSession& self, uint64_t decision, int64_t episode, int64_t step,
              Nanoseconds now) { return self.OnExported(decision, episode, step, Time(now)); })
      .def(
          "on_episode_ended",
          [](RobotSession& self, std::optional<double> episode_return) {
            return ToPython(self.OnEpisodeEnded(episode_return));
          },
          "episode_return"_a.none())
      .def("on_call_failed", [](RobotSession& self, const Error& error, size_t server,
                                Nanoseconds now) { self.OnCallFailed(error, server, Time(now)); })
      .def(
          "on_played",
          [](RobotSession& self, const std::optional<GivenAction>& action, std::string_view text,
             Nanoseconds now) { self.OnPlayed(MaybeAction(action).get(), text, Time(now)); },
          "action"_a.none(), "text"_a, "now"_a)
      .def("stop", &RobotSession::Stop)
      .def("take_lines", &RobotSession::TakeLines);
}

}  // namespace
}  // namespace spikeserve::robot

NB_MODULE(_robot, module) {
  module.doc() = "The robot's end of a session.";
  nanobind::set_leak_warnings(false);  // at the end of a process, a pilot's threads may hold it
  spikeserve::robot::BindEvents(module);
  nanobind::class_<spikeserve::robot::RobotSession> session(module, "RobotSession");
  spikeserve::robot::BindControlStep(session);
  spikeserve::robot::BindLink(session);
}
