// Calls the C++ client's pilot for spikeserve_robot.h, and keeps its exceptions inside.
#include <google/protobuf/util/json_util.h>

#include <algorithm>
#include <cstring>
#include <exception>
#include <map>
#include <memory>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "client/c/spikeserve_robot.h"
#include "core/base/version.h"
#include "spikeserve/client.h"
#include "spikeserve/local_engine.h"
#include "spikeserve/pilot.h"

using spikeserve::Pilot;

struct spikeserve_robot {
  std::unique_ptr<spikeserve::Client> client;
  std::unique_ptr<Pilot> pilot;
  uint64_t ended = 0;                                         // episodes
  std::map<uint64_t, std::future<Pilot::Summary>> summaries;  // the last ones, by episode
};

namespace {

constexpr size_t kMostSummaries = 4096;
// The clock counts nanoseconds, so that a later time would overflow it.
constexpr absl::Duration kLongestWait = absl::Hours(24 * 365);
constexpr size_t kFirstOptions = sizeof(spikeserve_robot_options_t);  // of the first release

int Report(const absl::Status& status, spikeserve_robot_error_t* error) {
  if (error != nullptr) {
    error->code = static_cast<int32_t>(status.code());
    const size_t size = std::min(status.message().size(), sizeof(error->message) - 1);
    std::copy_n(status.message().data(), size, error->message);
    error->message[size] = '\0';
  }
  return static_cast<int>(status.code());
}

// Calls `function`, which returns a status, and reports it.
template <typename Function>
int Guarded(spikeserve_robot_error_t* error, const Function& function) noexcept {
  try {
    return Report(function(), error);
  } catch (const std::exception& exception) {
    return Report(absl::InternalError(exception.what()), error);
  } catch (...) {
    return Report(absl::InternalError("an exception of an unknown type"), error);
  }
}

std::string Text(const char* text) { return text == nullptr ? "" : text; }

// Who chose a given action. A number that is none stays none.
spikeserve::ChosenBy ChosenByOf(const spikeserve_robot_action_t& action) {
  using Source = spikeserve::v1::ActionSource;
  const int kind = Source::Kind_IsValid(action.by) ? action.by : Source::Kind_ARRAYSIZE;
  return {static_cast<Source::Kind>(kind), absl::NullSafeStringView(action.operator_id)};
}

spikeserve::ActionView ViewOf(const spikeserve_robot_action_t& action) {
  return {action.discrete, {action.continuous, action.size}, ChosenByOf(action)};
}

void Write(const spikeserve::ActionView& view, spikeserve_robot_action_t* action) {
  *action = {};
  action->discrete = view.discrete;
  action->continuous = view.continuous.data();
  action->size = view.continuous.size();
}

spikeserve::v1::Action MessageOf(const spikeserve_robot_action_t& action) {
  spikeserve::v1::Action message;
  if (action.size == 0) {
    message.set_discrete(action.discrete);
  } else {
    message.mutable_continuous()->mutable_values()->Add(action.continuous,
                                                        action.continuous + action.size);
  }
  return message;
}

spikeserve::v1::ActionSource SourceOf(const spikeserve_robot_action_t& action) {
  const spikeserve::ChosenBy by = ChosenByOf(action);
  spikeserve::v1::ActionSource source;
  source.set_kind(by.kind);
  source.set_operator_id(std::string(by.operator_id));
  return source;
}

// Sets `option` unless the number stands for the default.
template <typename Option>
void Set(double number, Option* option) {
  if (!(number < 0)) *option = static_cast<int>(number);
}
void SetTime(double seconds, std::optional<absl::Duration>* option) {
  if (!(seconds < 0)) *option = absl::Seconds(seconds);
}

spikeserve::PilotOptions PilotOptionsOf(const spikeserve_robot_options_t& given) {
  spikeserve::PilotOptions options = {.period = absl::Seconds(given.period)};
  SetTime(given.budget, &options.budget);
  SetTime(given.max_age, &options.max_age);
  Set(given.hold_beats, &options.hold_beats);
  Set(given.ramp_beats, &options.ramp_beats);
  Set(given.in_flight, &options.in_flight);
  Set(given.kept_beats, &options.kept_beats);
  Set(given.redundancy, &options.redundancy);
  if (given.transport >= 0) {
    options.transport = static_cast<spikeserve::PilotTransport>(given.transport);
  }
  if (!(given.close_timeout < 0)) options.close_timeout = absl::Seconds(given.close_timeout);
  if (given.local_policy != nullptr) {
    const std::string path = given.local_policy;
    options.local = path.empty() ? spikeserve::LocalEngine::FromServer()
                                 : spikeserve::LocalEngine::FromFile(path);
  }
  if (given.neutral != nullptr) options.neutral = MessageOf(*given.neutral);
  if (given.fallback != nullptr) {
    options.fallback = [function = given.fallback,
                        context = given.context](absl::Span<const float> observation) {
      spikeserve_robot_action_t action = {};
      if (function(context, observation.data(), observation.size(), &action) == 0) {
        return ViewOf(action);
      }
      return spikeserve::ActionView{.discrete =
                                        -1};  // belongs to no space: the function has failed
    };
  }
  if (given.log != nullptr) {
    options.log = [function = given.log, context = given.context](absl::string_view line) {
      function(context, std::string(line).c_str());
    };
  }
  return options;
}

absl::Status Open(const spikeserve_robot_options_t& given, spikeserve_robot_t* robot) {
  if (given.size < kFirstOptions || given.size > sizeof(given)) {
    return absl::InvalidArgumentError(
        absl::StrCat("size: expected ", kFirstOptions, " to ", sizeof(given), ", received ",
                     given.size, ": the library is ", spikeserve_robot_version()));
  }
  if (given.transport > SPIKESERVE_ROBOT_DATAGRAM) {
    return absl::InvalidArgumentError(
        absl::StrCat("transport: expected 0 to 2, received ", given.transport));
  }
  spikeserve::v1::OpenSessionRequest request;
  if (given.session != nullptr) {
    const auto parsed = google::protobuf::util::JsonStringToMessage(given.session, &request);
    if (!parsed.ok()) {
      return absl::InvalidArgumentError(absl::StrCat(
          "session: expected JSON of OpenSessionRequest, received ", parsed.message().as_string()));
    }
  }
  if (given.policy != nullptr) request.set_policy(given.policy);
  spikeserve::ClientOptions options;
  options.security.tls = given.tls != 0;
  options.security.ca = Text(given.ca);
  options.security.certificate = Text(given.certificate);
  options.security.key = Text(given.key);
  options.security.token = Text(given.token);
  auto client = spikeserve::Client::Connect(
      Text(given.servers), options, absl::Seconds(given.patience < 0 ? 3.0 : given.patience));
  if (!client.ok()) return client.status();
  robot->client = *std::move(client);
  auto pilot = Pilot::Create(robot->client.get(), std::move(request), PilotOptionsOf(given));
  if (!pilot.ok()) return pilot.status();
  robot->pilot = *std::move(pilot);
  return absl::OkStatus();
}

}  // namespace

const char* spikeserve_robot_version(void) { return spikeserve::Version().data(); }

void spikeserve_robot_options_init(spikeserve_robot_options_t* options, size_t size) {
  spikeserve_robot_options_t filled = {};
  filled.size = size;
  filled.patience = filled.budget = filled.max_age = filled.close_timeout = -1.0;
  filled.hold_beats = filled.ramp_beats = filled.in_flight = filled.kept_beats = -1;
  filled.transport = filled.redundancy = -1;
  std::memcpy(options, &filled, std::min(size, sizeof(filled)));
}

int spikeserve_robot_open(const spikeserve_robot_options_t* options, spikeserve_robot_t** robot,
                          spikeserve_robot_error_t* error) {
  *robot = nullptr;
  return Guarded(error, [&] {
    auto opened = std::make_unique<spikeserve_robot_t>();
    const absl::Status status = Open(*options, opened.get());
    if (status.ok()) *robot = opened.release();
    return status;
  });
}

int spikeserve_robot_step(spikeserve_robot_t* robot, const float* observation, size_t size,
                          double reward, const spikeserve_robot_action_t* executed,
                          spikeserve_robot_action_t* action, spikeserve_robot_error_t* error) {
  return Guarded(error, [&] {
    std::optional<spikeserve::ActionView> view;
    if (executed != nullptr) view = ViewOf(*executed);
    const spikeserve::PilotAction chosen = robot->pilot->Beat({observation, size}, reward, view);
    Write(chosen.value, action);
    action->source = static_cast<int32_t>(chosen.source);
    action->age = absl::ToDoubleSeconds(chosen.age);
    action->step = chosen.beat;
    return chosen.status;
  });
}

int spikeserve_robot_wait_ready(spikeserve_robot_t* robot, double timeout) {
  bool is_ready = false;
  Guarded(nullptr, [&] {
    is_ready = robot->pilot->WaitReady(absl::Seconds(timeout));
    return absl::OkStatus();
  });
  return is_ready ? 1 : 0;
}

uint64_t spikeserve_robot_end_episode(spikeserve_robot_t* robot,
                                      const spikeserve_robot_outcome_t* outcome) {
  Guarded(nullptr, [&] {
    spikeserve::EpisodeOutcome ended = {.reward = outcome->reward,
                                        .terminated = outcome->terminated != 0,
                                        .truncated = outcome->truncated != 0};
    if (const auto* const executed = outcome->executed; executed != nullptr) {
      ended.executed_action.emplace(MessageOf(*executed), SourceOf(*executed));
    }
    robot->summaries[robot->ended] = robot->pilot->EndEpisode(ended);
    if (robot->summaries.size() > kMostSummaries) robot->summaries.erase(robot->summaries.begin());
    return absl::OkStatus();
  });
  return robot->ended++;
}

int spikeserve_robot_wait_summary(spikeserve_robot_t* robot, uint64_t episode, double timeout,
                                  spikeserve_robot_summary_t* summary,
                                  spikeserve_robot_error_t* error) {
  return Guarded(error, [&]() -> absl::Status {
    const auto found = robot->summaries.find(episode);
    if (found == robot->summaries.end()) {
      return absl::NotFoundError(
          absl::StrCat("episode: expected one whose summary waits, received ", episode));
    }
    const absl::Duration limit = std::min(absl::Seconds(timeout), kLongestWait);
    if (found->second.wait_for(absl::ToChronoNanoseconds(limit)) != std::future_status::ready) {
      return absl::DeadlineExceededError("the server does not have the episode yet");
    }
    const Pilot::Summary ended = found->second.get();
    robot->summaries.erase(found);
    if (!ended.ok()) return ended.status();
    *summary = {.steps = ended->steps(),
                .lost_steps = ended->lost_steps(),
                .episode_return = ended->episode_return()};
    return absl::OkStatus();
  });
}

void spikeserve_robot_stats(const spikeserve_robot_t* robot, spikeserve_robot_stats_t* stats) {
  const spikeserve::PilotStats counted = robot->pilot->Stats();
  spikeserve_robot_stats_t filled = {.size = stats->size,
                                     .steps = counted.beats,
                                     .by_source = {},
                                     .entries = {},
                                     .stale = counted.stale,
                                     .late_answers = counted.late_answers,
                                     .cancelled_calls = counted.cancelled_calls,
                                     .datagram_answers = counted.datagram_answers,
                                     .reconnects = counted.reconnects,
                                     .reopened = counted.reopened,
                                     .dropped = counted.dropped,
                                     .lost_episodes = counted.lost_episodes,
                                     .unequal_returns = counted.unequal_returns,
                                     .invalid = counted.invalid,
                                     .invalid_observations = counted.invalid_observations,
                                     .failures = counted.failures,
                                     .longest_gap = absl::ToDoubleSeconds(counted.longest_gap),
                                     .age_p50 = absl::ToDoubleSeconds(counted.age_p50),
                                     .age_p99 = absl::ToDoubleSeconds(counted.age_p99),
                                     .age_p999 = absl::ToDoubleSeconds(counted.age_p999),
                                     .has_local = counted.has_local,
                                     .local_head_is_copy = counted.local_head_is_copy,
                                     .sends_datagrams = counted.sends_datagrams,
                                     .stays_safe = counted.stays_safe};
  static_assert(spikeserve::kActionSources == 4);
  std::copy(counted.by_source.begin(), counted.by_source.end(), filled.by_source);
  std::copy(counted.entries.begin(), counted.entries.end(), filled.entries);
  std::memcpy(stats, &filled, std::min(stats->size, sizeof(filled)));
}

size_t spikeserve_robot_session_id(const spikeserve_robot_t* robot, char* id, size_t size) {
  const std::string text = robot->pilot->session_id();
  if (size > 0) id[text.copy(id, size - 1)] = '\0';
  return text.size();
}

void spikeserve_robot_close(spikeserve_robot_t* robot) { delete robot; }

const char* spikeserve_robot_source_name(int32_t source) {
  if (source < 0 || source >= static_cast<int32_t>(spikeserve::kActionSources)) return nullptr;
  return spikeserve::ActionSourceName(static_cast<spikeserve::ActionSource>(source)).data();
}
