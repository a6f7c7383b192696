// Journals of sessions: every list of records is refused, or restores a session that continues.
//
// An input is a list of records, each after its length in two bytes, the most significant first.
#include "core/journal/journal_entry.h"
#include "core/journal/session_bytes.h"
#include "core/session/session.h"
#include "core/session/session_value.h"
#include "tests/fuzz/fuzz_target.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

const std::shared_ptr<const ServedPolicy>& Served() {
  static const auto* const served = new std::shared_ptr<const ServedPolicy>(
      Serve(SmallConfig(), ActionSpace::Discrete(2)));  // lives as long as the process
  return *served;
}

std::string Framed(absl::string_view record) {
  const auto high = static_cast<char>(record.size() >> 8);
  const auto low = static_cast<char>(record.size());
  return std::string{high, low} + std::string(record);
}

std::vector<std::string> Records(absl::string_view input) {
  InputReader reader(input);
  std::vector<std::string> records;
  while (!reader.empty()) {
    const size_t high = reader.Byte();
    records.emplace_back(reader.Bytes(high << 8 | reader.Byte()));
  }
  return records;
}

}  // namespace

void FuzzOne(absl::string_view input) {
  const std::vector<std::string> records = Records(input);
  auto journal = ParseJournal(records);
  if (!journal.ok()) return;
  auto session = RestoreSession(*std::move(journal), Served()->policy());
  if (!session.ok()) return;
  // What was read can be written and read again.
  const std::string bytes = SerializeSession(*session);
  const auto again = ParseSession(bytes);
  FUZZ_CHECK(again.ok());
  FUZZ_CHECK(SerializeSession(*again) == bytes);
  const FakeClock clock;
  const int64_t step = session->step;
  const uint64_t decisions = session->decisions;
  AgentSession agent(Served(), *std::move(session), &clock);
  if (agent.Act(step, ObservationAt(step), RewardAt(step), ReportedAction(int64_t{1})).ok()) {
    FUZZ_CHECK(agent.session().decisions == decisions + 1);
    agent.AppendPendingAction();
  }
}

std::vector<std::string> Seeds() {
  std::vector<std::string> seeds;
  for (const bool learns : {false, true}) {
    SessionOptions options = SmallOptions();
    options.action_selection.sample = true;
    if (learns) options.learning = LearningOptions();
    const FakeClock clock;
    AgentSession agent(Served(), NewSession("id", options), &clock);
    std::string records = Framed(SerializeSession(agent.session()));
    for (int step = 0; step < 3; ++step) {
      const std::vector<float> observation = ObservationAt(step);
      const Answer& answer = **agent.Act(step, observation, RewardAt(step));
      const std::vector<float> readout(learns ? 16 : 0, 0.5f);
      records += Framed(SerializeEntry({.decision = static_cast<uint64_t>(step),
                                        .reward = RewardAt(step),
                                        .observation = observation,
                                        .executed = std::nullopt,
                                        .answer = answer,
                                        .readout = readout,
                                        .noise = {},
                                        .suspended = false}));
      agent.AppendPendingAction();
    }
    seeds.push_back(records);
    FUZZ_CHECK(agent.EndEpisode({.reward = 1.0, .terminated = true}).ok());
    seeds.push_back(Framed(SerializeSession(agent.session())));
  }
  return seeds;
}

}  // namespace spikeserve
