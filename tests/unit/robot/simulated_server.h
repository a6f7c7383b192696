// A server as a robot sees it: one session, whose answers tell nothing but which observation they
// are for, and a store that is behind it. docs/reference/beats.md has the rules.
#pragma once

#include <cstdint>
#include <deque>
#include <memory>
#include <optional>
#include <vector>

#include "core/robot/robot_session.h"

namespace spikeserve::robot {

constexpr int64_t kHistoryLimit = 40;

// A step as it was sent, or as a server or a robot knows it.
struct KnownStep {
  std::optional<float> observation = std::nullopt;
  double reward = 0.0;
  int64_t executed = -1;  // -1: not known

  bool operator==(const KnownStep&) const = default;
};

struct Message {
  uint64_t session = 0;
  uint64_t decision = 0;
  uint64_t step = 0;
  std::vector<double> skipped = {};
  std::vector<KnownStep> history = {};
  std::optional<KnownStep> newest = std::nullopt;  // asks for a decision
  Time observed_at = Time::zero();
  bool ends = false;
  double end_reward = 0.0;
  uint64_t end_steps = 0;
  int64_t end_executed = -1;
};

// Copies a request from a log, or the end of its oldest episode.
Message MessageOf(uint64_t session, const StepLog& log, const Request& request);

struct Answer {
  std::optional<Error> error = std::nullopt;
  Reply reply = {};
};

struct EndedEpisode {
  uint64_t first;
  std::vector<KnownStep> steps;
  double end_reward;

  double episode_return() const;
};

// The value of a session at the server.
struct ServedSession {
  uint64_t id = 0;  // 0: there is none
  uint64_t first = 0;
  std::vector<KnownStep> steps = {};  // of the running episode
  std::vector<std::shared_ptr<const EndedEpisode>> ended = {};

  uint64_t decisions() const { return first + steps.size(); }
};

class SimulatedServer {
 public:
  explicit SimulatedServer(bool is_stored) : is_stored_(is_stored) {}

  // Opens the next session.
  Opening Open();
  // Answers a request on the stream. An old server ignores ends.
  Answer Act(const Message& message, bool is_old);
  // Answers EndEpisode.
  Answer End(const Message& message);
  // Writes up to `count` changes to the store.
  void Store(size_t count);
  // Loses what is not in the store.
  void Kill();
  // Loses the session, also in the store.
  void Lose() { session_ = stored_ = {}; }
  // Takes a step of another robot with the session's id. Returns whether it is the first one.
  bool Intrude();

  const ServedSession& session() const { return session_; }

 private:
  Answer Expected() const;
  Answer Finish(bool has_ended);
  bool Differs(const Message& message) const;
  bool Append(const Message& message);

  const bool is_stored_;
  uint64_t opened_ = 0;
  bool is_intruded_ = false;
  ServedSession session_;
  ServedSession stored_;
  std::deque<ServedSession> waiting_;
};

}  // namespace spikeserve::robot
