#include "client/python/engine/batch_answers.h"

#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

void Append(const std::vector<float>& from, std::vector<float>* to) {
  to->insert(to->end(), from.begin(), from.end());
}

}  // namespace

void BatchAnswers::Append(const Answer& answer) {
  SPIKESERVE_DCHECK_EQ(logits_.size(), rows_.size() * answer.logits.size());
  rows_.push_back({.step = answer.step,
                   .discrete = answer.action.discrete,
                   .return_to_go = answer.return_to_go,
                   .counts = answer.counts,
                   .unusual_observations = answer.unusual_observations,
                   .compute_seconds = answer.compute_seconds});
  spikeserve::Append(answer.logits, &logits_);
  spikeserve::Append(answer.probabilities, &probabilities_);
  spikeserve::Append(answer.action.continuous, &continuous_);
}

Answer BatchAnswers::At(size_t row) const {
  const Row& from = rows_[row];
  Answer answer;
  answer.step = from.step;
  answer.action.discrete = static_cast<int>(from.discrete);
  answer.action.continuous = Part(continuous_, row);
  answer.probabilities = Part(probabilities_, row);
  answer.return_to_go = from.return_to_go;
  answer.counts = from.counts;
  answer.unusual_observations = from.unusual_observations;
  answer.compute_seconds = from.compute_seconds;
  answer.logits = Part(logits_, row);
  return answer;
}

std::vector<float> BatchAnswers::Part(const std::vector<float>& values, size_t row) const {
  const size_t width = values.size() / rows_.size();
  const auto begin = values.begin() + static_cast<ptrdiff_t>(row * width);
  return {begin, begin + static_cast<ptrdiff_t>(width)};
}

}  // namespace spikeserve
