// Sequences of requests to one session: its counters follow a model, errors change nothing, and
// nothing is decided twice.
#include "core/agent/agent_session.h"
#include "core/journal/session_bytes.h"
#include "core/session/session.h"
#include "core/session/session_value.h"
#include "tests/fuzz/fuzz_target.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

enum class Request { kNext, kRetry, kAnyStep, kEnd, kCompact, kMove, kCount };

const std::shared_ptr<const ServedPolicy>& Served() {
  static const auto* const served = new std::shared_ptr<const ServedPolicy>(
      Serve(SmallConfig(), ActionSpace::Discrete(2)));  // lives as long as the process
  return *served;
}

// What the session must have counted.
struct Model {
  int64_t episode = 0;
  int64_t step = 0;
  uint64_t decisions = 0;
  double episode_return = 0.0;
  uint8_t argument = 0;  // of the last step
};

class Game {
 public:
  explicit Game(const SessionOptions& options)
      : agent_(std::make_unique<AgentSession>(Served(), NewSession("id", options), &clock_)) {}

  void Apply(Request request, uint8_t argument) {
    switch (request) {
      case Request::kNext:
        return Act(model_.step, argument);
      case Request::kRetry:
        return Retry();
      case Request::kAnyStep:
        return Act(static_cast<int64_t>(argument) - 128, argument);
      case Request::kEnd:
        return End(argument);
      case Request::kCompact:
        return agent_->Compact();
      case Request::kMove:
        return Move();
      case Request::kCount:
        return;
    }
  }

  void Check() const {
    const Session& session = agent_->session();
    FUZZ_CHECK(session.episode == model_.episode);
    FUZZ_CHECK(session.step == model_.step);
    FUZZ_CHECK(session.decisions == model_.decisions);
    FUZZ_CHECK(session.episode_return == model_.episode_return);
  }

 private:
  // Asks for a decision, which is made if `step` is the next one.
  void Act(int64_t step, uint8_t argument) {
    const std::string before = SerializeSession(agent_->session());
    const double reward = argument / 16.0;
    const bool is_next = step == model_.step;
    const auto answer = agent_->Act(step, ObservationAt(argument), reward);
    if (!is_next) {
      // A retry of the last step is answered; every other step, and another content, is refused.
      const bool is_last = model_.step > 0 && step == model_.step - 1;
      FUZZ_CHECK(answer.ok() == (is_last && argument == model_.argument));
      FUZZ_CHECK(SerializeSession(agent_->session()) == before);
      return;
    }
    FUZZ_CHECK(answer.ok());
    FUZZ_CHECK((*answer)->step == step);
    if (step > 0) model_.episode_return += reward;
    model_.argument = argument;
    ++model_.step;
    ++model_.decisions;
    agent_->AppendPendingAction();
  }

  void Retry() {
    if (model_.step == 0) return;
    const Answer stored = *agent_->session().last_answer;
    const uint8_t argument = model_.argument;
    const auto answer = agent_->Act(model_.step - 1, ObservationAt(argument), argument / 16.0);
    FUZZ_CHECK(answer.ok());
    FUZZ_CHECK(**answer == stored);
  }

  void End(uint8_t argument) {
    const bool is_repeated = model_.step == 0 && agent_->session().last_end != nullptr;
    const double reward = argument / 16.0;
    const auto summary = agent_->EndEpisode({.reward = reward, .terminated = argument % 2 == 0});
    if (model_.step == 0) {
      FUZZ_CHECK(summary.ok() == is_repeated || !summary.ok());
      return;
    }
    FUZZ_CHECK(summary.ok());
    model_ = {.episode = model_.episode + 1, .step = 0, .decisions = model_.decisions};
  }

  // The session goes to another process.
  void Move() {
    auto session = ParseSession(SerializeSession(agent_->session()));
    FUZZ_CHECK(session.ok());
    agent_ = std::make_unique<AgentSession>(Served(), *std::move(session), &clock_);
  }

  const FakeClock clock_;
  std::unique_ptr<AgentSession> agent_;
  Model model_;
};

}  // namespace

void FuzzOne(absl::string_view input) {
  InputReader reader(input);
  const uint8_t flags = reader.Byte();
  SessionOptions options = SmallOptions();
  options.action_selection.sample = (flags & 1) != 0;
  if ((flags & 2) != 0) options.learning = LearningOptions();
  Game game(options);
  for (int i = 0; i < 200 && !reader.empty(); ++i) {
    const auto request = static_cast<Request>(reader.Byte() % static_cast<int>(Request::kCount));
    game.Apply(request, reader.Byte());
    game.Check();
  }
}

std::vector<std::string> Seeds() {
  std::vector<std::string> seeds;
  for (char flags = 0; flags < 4; ++flags) {
    seeds.push_back(std::string(1, flags) +
                    std::string("\0a\0b\1c\0d\5e\0f\4g\0h\3i\0j\2k\3l", 24));
  }
  return seeds;
}

}  // namespace spikeserve
