#include "core/learning/correction_runs.h"

#include <algorithm>
#include <iterator>
#include <utility>

namespace spikeserve {

void CorrectionRuns::Add(absl::string_view operator_id, double now, const Eigen::VectorXf& head,
                         const Corrections& measured) {
  if (runs.empty() || runs.back().operator_id != operator_id ||
      now >= runs.back().began + kSeconds) {
    if (runs.size() == kMost) {
      forgotten = runs.front().ended;
      runs.erase(runs.begin());
    }
    runs.push_back({.operator_id = std::string(operator_id),
                    .began = now,
                    .before = head,
                    .measured = measured});
  }
  runs.back().ended = now;
  ++runs.back().updates;
}

void CorrectionRuns::Forget() {
  if (!runs.empty()) forgotten = runs.back().ended;
  runs.clear();
}

std::optional<int64_t> CorrectionRuns::Undo(absl::string_view operator_id, double since,
                                            Eigen::VectorXf* head, Corrections* measured) {
  if (forgotten >= since) return std::nullopt;
  const auto is_undone = [&](const CorrectionRun& run) {
    return run.operator_id == operator_id && run.ended >= since;
  };
  const auto first = std::find_if(runs.begin(), runs.end(), is_undone);
  if (first == runs.end()) return 0;
  Eigen::VectorXf without = first->before;
  Corrections before = first->measured;
  before.steps = measured->steps;
  before.in_episode = measured->in_episode;
  int64_t updates = 0;
  std::vector<CorrectionRun> kept(runs.begin(), first);
  for (auto run = first; run != runs.end(); ++run) {
    if (is_undone(*run)) {
      updates += run->updates;
      continue;
    }
    const Eigen::VectorXf& after = std::next(run) == runs.end() ? *head : std::next(run)->before;
    const Eigen::VectorXf change = after - run->before;
    kept.push_back(*run);
    kept.back().before = without;
    without += change;
  }
  runs = std::move(kept);
  *head = std::move(without);
  *measured = before;
  return updates;
}

}  // namespace spikeserve
