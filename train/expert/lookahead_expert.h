// An expert that searches `depth` steps ahead with the exact model and takes the value of the
// states at the end of the search from a value table.
#pragma once

#include <algorithm>
#include <memory>
#include <utility>

#include "train/expert/expert.h"
#include "train/expert/value_table.h"

namespace spikeserve {

template <int D>
class LookaheadExpert final : public Expert {
 public:
  // REQUIRES: depth >= 1.
  LookaheadExpert(Problem problem, std::shared_ptr<const ValueTable<D>> table, int depth)
      : problem_(std::move(problem)), table_(std::move(table)), depth_(depth) {}

  Action Act(absl::Span<const double> state) override {
    return problem_.choices[table_->Best(problem_, Start(state), depth_).choice].action;
  }

  double StateImportance(absl::Span<const double> state) override {
    return table_->StateImportance(problem_, Start(state), depth_);
  }

  std::unique_ptr<Expert> Clone() const override {
    return std::make_unique<LookaheadExpert>(*this);
  }

 private:
  static typename ValueTable<D>::State Start(absl::Span<const double> state) {
    typename ValueTable<D>::State start;
    std::copy_n(state.begin(), D, start.begin());
    return start;
  }

  Problem problem_;
  std::shared_ptr<const ValueTable<D>> table_;
  int depth_;
};

}  // namespace spikeserve
