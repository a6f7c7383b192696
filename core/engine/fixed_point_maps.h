// Computes the maps and norms of integer arithmetic as docs/design/integer.md defines them, one
// number at a time.
//
// For the reference engine, for dense policies and for training; the streaming engine has kernels.
// All functions are pure and thread-safe.
#pragma once

#include <cstdint>
#include <vector>

#include "core/model/config.h"
#include "core/model/fixed_point_weights.h"

namespace spikeserve {

// Returns RoundShift(W x, shift - exponent) + b [out] for the input x * 2^exponent, where x is
// `input` [in].
std::vector<int32_t> ApplyMap(const FixedPointMap& map, const std::vector<int32_t>& input,
                              int exponent = 0);

// Replaces x [d], saturated, by its norm.
void NormalizeResidual(const FixedPointNorm& norm, std::vector<int32_t>& x);

// Limits the numbers of x [d], which no norm follows.
void LimitResidual(std::vector<int32_t>& x);

// Replaces the scores [H] of routing.gate by gates with kGateFraction fraction bits. Returns the
// number of terms of a softmax that it computed.
uint64_t GateScores(const ModelConfig& config, std::vector<int32_t>& scores);

}  // namespace spikeserve
