// The answers to the rows of one batch.
//
// Holds the numbers of all rows in one array for each kind, because a copy of every Answer would
// allocate several vectors a row. A plain value.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/engine/counts.h"
#include "core/session/session.h"

namespace spikeserve {

class BatchAnswers {
 public:
  // The part of an answer that has the same size in every policy.
  struct Row {
    int64_t step = 0;
    int64_t discrete = 0;  // the action of a Discrete space
    float return_to_go = 0.0f;
    Counts counts;
    uint32_t unusual_observations = 0;
    double compute_seconds = 0.0;
  };

  void Reserve(size_t rows) { rows_.reserve(rows); }
  // Appends a copy of `answer`. REQUIRES: all answers are of one policy.
  void Append(const Answer& answer);

  const std::vector<Row>& rows() const { return rows_; }
  const std::vector<float>& logits() const { return logits_; }                // [rows][act]
  const std::vector<float>& probabilities() const { return probabilities_; }  // Discrete only
  const std::vector<float>& continuous() const { return continuous_; }        // Box only

  // Returns a copy of the answer that was appended as number `row`.
  Answer At(size_t row) const;

 private:
  // Returns the part of `values` that belongs to `row`.
  std::vector<float> Part(const std::vector<float>& values, size_t row) const;

  std::vector<Row> rows_;
  std::vector<float> logits_;
  std::vector<float> probabilities_;
  std::vector<float> continuous_;
};

}  // namespace spikeserve
