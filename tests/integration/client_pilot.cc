// Flies a pilot of the C++ client, as the lines of its standard input say. Used by
// tests/python/pilot/test_cpp_pilot.py.
//
// Each line is a JSON object, and is answered by one: {"error": ...} or the result. The first one
// makes the pilot:
//
//   {"servers": "HOST:PORT", "opening": HEX, "period": 0.01}, and, if wanted: "local": PATH ("":
//   the server's policy file), "ca", "token", and fields of PilotOptions by name, times in seconds;
//   "traceparent" is that of all beats; "watches_answers" adds to each beat of an episode "newest",
//   the step of the newest answer that had arrived before it, and "answers", the step whose
//   observation its action was chosen for
//
//   {"do": "beat", "observation": [...], "reward": 0.5, "executed": [...]}
//   {"do": "end", "reward": 1, "terminated": true}    begins to wait for the next summary
//   {"do": "summary", "episode": 0, "timeout": 10}    returns {} if it is not there in time
//   {"do": "stats"}
//   {"do": "value"}                                   of the session of the local engine, as HEX
//   {"do": "wait", "timeout": 10}                     for an answer to be executed
//   {"do": "suspend", "seconds": 15}                  lets CLOCK_BOOTTIME jump
//   {"do": "close"}
//
// A number that JSON has no word for is null: NaN. A beat tells how often its thread has called
// operator new.
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <iostream>
#include <limits>
#include <memory>
#include <new>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "absl/strings/escaping.h"
#include "core/base/hex.h"
#include "spikeserve/client.h"
#include "spikeserve/local_engine.h"
#include "spikeserve/pilot.h"
#include "tests/integration/answer_watch.h"

namespace {

thread_local uint64_t allocations = 0;
std::atomic<time_t> seconds_asleep = 0;

void* Allocate(size_t size) {
  ++allocations;
  void* const memory = std::malloc(size == 0 ? 1 : size);
  if (memory == nullptr) throw std::bad_alloc();
  return memory;
}

}  // namespace

// Takes the place of the C library's function, for all of the process.
extern "C" int clock_gettime(clockid_t clock, timespec* time) noexcept {
  const auto result = static_cast<int>(syscall(SYS_clock_gettime, clock, time));
  if (clock == CLOCK_BOOTTIME) time->tv_sec += seconds_asleep.load();
  return result;
}

// The compiler would complain that memory of operator new is freed by free().
void* operator new(size_t size) { return Allocate(size); }
void* operator new[](size_t size) { return Allocate(size); }
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete[](void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, size_t) noexcept { std::free(memory); }
void operator delete[](void* memory, size_t) noexcept { std::free(memory); }

namespace spikeserve {
namespace {

using Json = nlohmann::json;

double Number(const Json& json) {
  return json.is_null() ? std::numeric_limits<double>::quiet_NaN() : json.get<double>();
}

std::vector<float> Numbers(const Json& json) {
  std::vector<float> numbers;
  for (const Json& number : json) numbers.push_back(static_cast<float>(Number(number)));
  return numbers;
}

std::optional<absl::Duration> Seconds(const Json& json, const char* name) {
  if (!json.contains(name)) return std::nullopt;
  return absl::Seconds(json[name].get<double>());
}

PilotOptions OptionsOf(const Json& json) {
  PilotOptions options = {.period = absl::Seconds(json.at("period").get<double>()),
                          .budget = Seconds(json, "budget"),
                          .max_age = Seconds(json, "max_age")};
  options.hold_beats = json.value("hold_beats", options.hold_beats);
  if (json.contains("ramp_beats")) options.ramp_beats = json["ramp_beats"].get<int>();
  if (json.contains("in_flight")) options.in_flight = json["in_flight"].get<int>();
  options.kept_beats = json.value("kept_beats", options.kept_beats);
  if (json.contains("transport")) {
    const auto name = json["transport"].get<std::string>();
    options.transport = name == "stream"     ? PilotTransport::kStream
                        : name == "datagram" ? PilotTransport::kDatagram
                                             : PilotTransport::kAuto;
  }
  options.redundancy = json.value("redundancy", options.redundancy);
  options.close_timeout = Seconds(json, "close_timeout").value_or(options.close_timeout);
  if (json.contains("traceparent")) {
    options.traceparent = [text = json["traceparent"].get<std::string>()]() -> absl::string_view {
      return text;
    };
  }
  if (json.contains("throwing")) {
    options.fallback = [](absl::Span<const float>) -> ActionView { throw std::bad_alloc(); };
  }
  return options;
}

Json ActionOf(const ActionView& action) {
  if (action.continuous.empty()) return action.discrete;
  return std::vector<float>(action.continuous.begin(), action.continuous.end());
}

Json StatsOf(const PilotStats& stats) {
  Json json = {{"beats", stats.beats},
               {"stale", stats.stale},
               {"late_answers", stats.late_answers},
               {"cancelled_calls", stats.cancelled_calls},
               {"datagram_answers", stats.datagram_answers},
               {"sends_datagrams", stats.sends_datagrams},
               {"reconnects", stats.reconnects},
               {"reopened", stats.reopened},
               {"dropped", stats.dropped},
               {"lost_episodes", stats.lost_episodes},
               {"unequal_returns", stats.unequal_returns},
               {"invalid", stats.invalid},
               {"invalid_observations", stats.invalid_observations},
               {"last_invalid_observation", stats.last_invalid_observation},
               {"failures", stats.failures},
               {"longest_gap", absl::ToDoubleSeconds(stats.longest_gap)},
               {"age_p50", absl::ToDoubleSeconds(stats.age_p50)},
               {"age_p99", absl::ToDoubleSeconds(stats.age_p99)},
               {"age_p999", absl::ToDoubleSeconds(stats.age_p999)},
               {"has_local", stats.has_local},
               {"local_head_is_copy", stats.local_head_is_copy},
               {"stays_safe", stats.stays_safe}};
  for (size_t i = 0; i < kActionSources; ++i) {
    const std::string name(ActionSourceName(static_cast<ActionSource>(i)));
    json[name] = stats.by_source[i];
    json["entries"][name] = stats.entries[i];
  }
  return json;
}

Json ErrorOf(const absl::Status& status) {
  return {{"error", std::string(status.message())}, {"code", static_cast<int>(status.code())}};
}

class Player {
 public:
  absl::Status Start(const Json& json) {
    watches_answers_ = json.contains("watches_answers");
    if (watches_answers_) WatchAnswers();
    ClientOptions options;
    options.security.ca = json.value("ca", "");
    options.security.token = json.value("token", "");
    auto client = Client::Connect(json.at("servers").get<std::string>(), options,
                                  absl::Seconds(json.value("patience", 30.0)));
    if (!client.ok()) return client.status();
    client_ = *std::move(client);
    v1::OpenSessionRequest opening;
    opening.ParseFromString(ParseHex(json.at("opening").get<std::string>()).value());
    PilotOptions pilot_options = OptionsOf(json);
    if (json.contains("local")) {
      const auto path = json["local"].get<std::string>();
      engine_ = path.empty() ? LocalEngine::FromServer() : LocalEngine::FromFile(path);
      pilot_options.local = engine_;
    }
    auto pilot = Pilot::Create(client_.get(), std::move(opening), std::move(pilot_options));
    if (!pilot.ok()) return pilot.status();
    pilot_ = *std::move(pilot);
    return absl::OkStatus();
  }

  Json Do(const Json& json) {
    const auto what = json.at("do").get<std::string>();
    if (what == "beat") return Beat(json);
    if (what == "stats") return StatsOf(pilot_->Stats());
    if (what == "session") return pilot_->session_id();
    if (what == "value") return absl::BytesToHexString(engine_->Export().value());
    if (what == "end") {
      summaries_.push_back(pilot_->EndEpisode(
          {.reward = Number(json.at("reward")), .terminated = json.at("terminated").get<bool>()}));
      return Json::object();
    }
    if (what == "summary") return Summary(json);
    if (what == "wait") return pilot_->WaitReady(absl::Seconds(json.at("timeout").get<double>()));
    if (what == "suspend") {
      seconds_asleep += json.at("seconds").get<time_t>();
      return Json::object();
    }
    pilot_->Close();
    return Json::object();
  }

 private:
  Json Beat(const Json& json) {
    const std::vector<float> observation = Numbers(json.at("observation"));
    const double reward = Number(json.at("reward"));
    std::optional<ActionView> executed;
    std::vector<float> values;
    const std::string operator_id = json.value("operator_id", "");
    if (json.contains("executed")) {
      values = Numbers(json["executed"]);
      const auto kind = static_cast<v1::ActionSource::Kind>(json.value("source", 0));
      executed = ActionView{.continuous = values, .by = {kind, operator_id}};
    }
    const int64_t newest = watches_answers_ ? NewestAnswer() : -1;
    began_.push_back(std::chrono::steady_clock::now());
    const uint64_t before = allocations;
    const PilotAction action = pilot_->Beat(observation, reward, executed);
    const uint64_t allocated = allocations - before;
    if (!action.status.ok()) return {{"invalid", std::string(action.status.message())}};
    Json answer = {{"action", ActionOf(action.value)},
                   {"source", std::string(ActionSourceName(action.source))},
                   {"age", absl::ToDoubleSeconds(action.age)},
                   {"beat", action.beat},
                   {"allocations", allocated}};
    if (watches_answers_) {
      answer["newest"] = newest;
      answer["answers"] = BeatBefore(action.age);
    }
    return answer;
  }

  // Returns the last beat that had begun at least `age` ago.
  int64_t BeatBefore(absl::Duration age) const {
    const auto time = std::chrono::steady_clock::now() - absl::ToChronoNanoseconds(age);
    return std::upper_bound(began_.begin(), began_.end(), time) - began_.begin() - 1;
  }

  Json Summary(const Json& json) {
    const auto timeout = std::chrono::duration<double>(json.at("timeout").get<double>());
    auto& summary = summaries_.at(json.at("episode").get<size_t>());
    if (summary.wait_for(timeout) != std::future_status::ready) return Json::object();
    const Pilot::Summary result = summary.get();
    if (!result.ok()) return ErrorOf(result.status());
    return {{"steps", result->steps()},
            {"episode_return", result->episode_return()},
            {"lost_steps", result->lost_steps()}};
  }

  std::unique_ptr<Client> client_;
  std::shared_ptr<LocalEngine> engine_;
  std::unique_ptr<Pilot> pilot_;
  std::vector<std::future<Pilot::Summary>> summaries_;
  bool watches_answers_ = false;
  std::vector<std::chrono::steady_clock::time_point> began_;  // of each beat
};

}  // namespace
}  // namespace spikeserve

int main() {
  using spikeserve::Json;
  spikeserve::Player player;
  std::string line;
  bool has_begun = false;
  while (std::getline(std::cin, line)) {
    const Json json = Json::parse(line);
    Json answer = Json::object();
    if (has_begun) {
      answer = player.Do(json);
    } else if (const absl::Status status = player.Start(json); !status.ok()) {
      answer = spikeserve::ErrorOf(status);
    }
    has_begun = true;
    std::cout << answer << std::endl;
  }
  return 0;
}
