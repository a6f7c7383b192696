#include "core/learning/correction.h"

#include "core/contract/dcheck.h"
#include "core/math/exp.h"
#include "core/math/vector_view.h"

namespace spikeserve {

Eigen::VectorXf Prediction(const ActionSpace& space, const Eigen::VectorXf& logits) {
  SPIKESERVE_DCHECK_EQ(logits.size(), space.size());
  if (!space.is_discrete()) return logits.unaryExpr(&Tanh);
  const Eigen::VectorXf odds = (logits.array() - logits.maxCoeff()).unaryExpr(&Exp);
  return odds / odds.sum();
}

Eigen::VectorXf Target(const ActionSpace& space, const Action& executed) {
  Eigen::VectorXf target(space.size());
  space.Encode(executed, {target.data(), static_cast<size_t>(target.size())});
  return target;
}

bool AgreesWith(const ActionSpace& space, const Eigen::VectorXf& logits, const Action& executed) {
  if (!space.is_discrete()) return false;
  Eigen::Index best = 0;
  logits.maxCoeff(&best);
  return best == executed.discrete;
}

}  // namespace spikeserve
