#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <vector>

#include "core/engine/fixed_point_maps.h"
#include "core/engine/reference/prefix_pass.h"
#include "core/engine/reference/reference_engine.h"
#include "core/engine/token_costs.h"
#include "core/math/fixed_point.h"
#include "core/neuron/phase.h"
#include "core/neuron/shift_lif.h"

namespace spikeserve {
namespace {

using Integers = std::vector<int32_t>;

// A spike train and, for each neuron, its number of spikes.
struct Fired {
  SpikeTrain spikes;  // [T][neurons]
  Integers counts;    // [neurons]
};

// The ticks of a token that attention takes together: some of the planes, which
// ModelConfig::attention_planes() counts.
using Group = std::vector<int>;

// The weights of the keys of one head, and their sum.
struct Row {
  std::vector<int64_t> weights;  // [keys]
  int64_t sum = 0;
};

Fired MakeFired(int ticks, size_t neurons) {
  return {SpikeTrain(ticks, std::vector<uint8_t>(neurons, 0)), Integers(neurons, 0)};
}

// Computes one decision over the whole episode. Symbols: T ticks, H heads, d hidden size, d_h head
// size.
class IntegerReferencePass : private PrefixPass {
 public:
  using PrefixPass::PrefixPass;

  void Run(Engine::Output* output) {
    for (size_t i = 0; i < tokens_.size(); ++i) Embed(i);
    CountPhase();
    for (int layer = 0; layer < config_.layers; ++layer) Layer(layer);
    const size_t last = tokens_.size() - 1;
    const Fired rates = Code(policy_.weights.fixed_point.readout_coder, last);
    AddSpikes(last, Stage::kReadout, kNoLayer, rates.spikes);
    output->readout.clear();
    for (const int32_t count : rates.counts) {
      output->readout.push_back(static_cast<float>(count) / static_cast<float>(config_.ticks));
    }
    counts_.multiply_accumulates += CountProducts(policy_.weights.head, output->readout);
    counts_.weight_bytes += sizeof(float) * policy_.weights.head.weight.values.size();
    output->counts = counts_;
  }

 private:
  // Counts the products of a map with 8-bit weights.
  void AddMultiplies(size_t token, const FixedPointMap& map, const Integers& input, bool wide) {
    if (!IsNew(token)) return;
    const uint64_t products = CountProducts(map, input);
    counts_.multiply_accumulates += products;
    counts_.integer_multiply_accumulates += products;
    if (wide) counts_.wide_multiply_accumulates += products;
  }

  // Counts the weights of a map that all new tokens share. The state token is always among them.
  void AddSharedReads(size_t token, const FixedPointMap& map) {
    if (!IsNew(token) || tokens_[token].kind != TokenKind::kState) return;
    counts_.weight_bytes += map.weight.values.size();
  }

  void NormalizeToken(size_t i, const FixedPointNorm& norm, Integers& x) {
    if (!config_.has_norms()) return LimitResidual(x);
    NormalizeResidual(norm, x);
    if (IsNew(i)) counts_.layer_norm_elements += x.size();
  }

  void Embed(size_t i) {
    const FixedPointEmbedding& embedding =
        EmbeddingOf(policy_.weights.fixed_point, tokens_[i].kind);
    Integers input;
    for (const float value : tokens_[i].input) {
      const float scaled = std::ldexp(value, config_.input_fraction);
      input.push_back(static_cast<int32_t>(
          std::nearbyint(std::clamp<float>(scaled, -kLargestResidual, kLargestResidual))));
    }
    AddMultiplies(i, embedding.linear, input, /*wide=*/true);
    if (IsNew(i)) counts_.weight_bytes += embedding.linear.weight.values.size();
    x_.push_back(ApplyMap(embedding.linear, input));
    NormalizeToken(i, embedding.norm, x_.back());
  }

  // Returns the phase spikes of a timestep: [T][H], or [T][0] without phase generators.
  SpikeTrain PhaseSpikes(int64_t timestep) const {
    SpikeTrain train(config_.ticks);
    if (!config_.has_phase()) return train;
    for (int k = 0; k < config_.heads; ++k) {
      const IntegerPhase phase = MakeIntegerPhase(
          policy_.weights.phase_omega.values[k], policy_.weights.phase_phi.values[k], config_.ticks,
          config_.phase_clock == PhaseClock::kWindow);
      for (int tick = 0; tick < config_.ticks; ++tick) {
        train[tick].push_back(IntegerPhase::Spike(phase.At(timestep, static_cast<uint32_t>(tick))));
      }
    }
    return train;
  }

  void CountPhase() {
    if (!config_.has_phase()) return;
    AddSpikes(tokens_.size() - 1, Stage::kPhase, kNoLayer, PhaseSpikes(tokens_.back().timestep));
  }

  // Returns the spikes of a coder for the residual of token i.
  Fired Code(const PeriodCoder& coder, size_t i) {
    Fired coded = MakeFired(config_.ticks, x_[i].size());
    for (size_t j = 0; j < x_[i].size(); ++j) {
      if (IsNew(i)) ++counts_.coder_gains;
      const int32_t signed_x = coder.sign.values[j] * x_[i][j];
      int period = 1;
      while (period <= config_.ticks &&
             signed_x <= coder.threshold.at(static_cast<int>(j), period - 1)) {
        ++period;
      }
      for (int tick = period; tick <= config_.ticks; tick += period) {
        coded.spikes[tick - 1][j] = 1;
        ++coded.counts[j];
      }
    }
    return coded;
  }

  // Returns the spikes of a population that receives `inputs` [T][in].
  Fired Fire(const IntegerPopulation& population, const SpikeTrain& inputs, size_t token) {
    const ShiftLif lif = {config_.leak()};
    const size_t outputs = population.bias.values.size();
    Fired fired = MakeFired(config_.ticks, outputs);
    std::vector<int16_t> membranes(outputs, 0);
    std::vector<uint8_t> fires(inputs[0].size(), 0);  // at some tick
    int last_event = 0;
    for (int tick = 1; tick <= config_.ticks; ++tick) {
      const std::vector<uint8_t>& input = inputs[tick - 1];
      for (size_t i = 0; i < outputs; ++i) lif.Leak(population.bias.values[i], membranes[i]);
      if (std::count(input.begin(), input.end(), 1) == 0) continue;
      if (IsNew(token)) {
        counts_.accumulates += CountProducts(population, input);
        counts_.membrane_updates += outputs;
        counts_.membrane_leaks += outputs * static_cast<uint64_t>(tick - std::max(last_event, 1));
      }
      last_event = tick;
      for (size_t j = 0; j < input.size(); ++j) fires[j] |= input[j];
      for (size_t i = 0; i < outputs; ++i) {
        int16_t current = 0;
        for (size_t j = 0; j < input.size(); ++j) {
          if (input[j]) {
            current = static_cast<int16_t>(
                current + population.weight.at(static_cast<int>(i), static_cast<int>(j)));
          }
        }
        if (!ShiftLif::Charge(current, population.threshold.values[i], membranes[i])) continue;
        fired.spikes[tick - 1][i] = 1;
        ++fired.counts[i];
      }
    }
    if (IsNew(token)) {
      counts_.weight_bytes += CountProducts(population, fires);
      if (last_event > 0) counts_.driven_neurons += outputs;
    }
    return fired;
  }

  void Layer(int layer) {
    const LayerWeights& weights = policy_.weights.layers[layer];
    const bool last_layer = layer + 1 == config_.layers;
    keys_.clear();
    values_.clear();
    for (size_t i = 0; i < tokens_.size(); ++i) {
      const Fired coded = Code(weights.fixed_point.coder, i);
      SpikeTrain inputs = coded.spikes;
      const SpikeTrain phase = PhaseSpikes(tokens_[i].timestep);
      for (int tick = 0; tick < config_.ticks; ++tick) {
        inputs[tick].insert(inputs[tick].end(), phase[tick].begin(), phase[tick].end());
      }
      keys_.push_back(Fire(weights.integer.key, inputs, i));
      const Fired value = Fire(weights.integer.value, inputs, i);
      values_.push_back(Planes(value));
      AddSpikes(i, Stage::kCoder, layer, coded.spikes);
      AddSpikes(i, Stage::kKey, layer, keys_[i].spikes);
      AddSpikes(i, Stage::kValue, layer, value.spikes);
      CountStoring(i);
      // In the last layer, only the state token's output is used.
      if (last_layer && tokens_[i].kind != TokenKind::kState) continue;
      const Fired query = Fire(weights.integer.query, inputs, i);
      AddSpikes(i, Stage::kQuery, layer, query.spikes);
      Attention(layer, query, i);
      FeedForward(layer, i);
    }
  }

  int TicksOf(const Group& group) const {
    return static_cast<int>(group.size()) * config_.plane_ticks();
  }

  // Returns the spike counts of each plane, [planes][neurons].
  std::vector<Integers> Planes(const Fired& fired) const {
    std::vector<Integers> planes(config_.attention_planes(), Integers(fired.counts.size(), 0));
    for (int tick = 0; tick < config_.ticks; ++tick) {
      for (size_t k = 0; k < fired.counts.size(); ++k) {
        planes[tick / config_.plane_ticks()][k] += fired.spikes[tick][k];
      }
    }
    return planes;
  }

  // Returns the groups of planes: each at which the query fires, and all others together.
  std::vector<Group> Groups(const Fired& query) const {
    std::vector<Group> groups;
    Group silent;
    for (int plane = 0; plane < config_.attention_planes(); ++plane) {
      if (Fires(query, {plane}, 0, config_.hidden_size)) {
        groups.push_back({plane});
      } else {
        silent.push_back(plane);
      }
    }
    if (!silent.empty()) groups.push_back(silent);
    return groups;
  }

  // Counts the bytes of the key and the value of a token, the additions by which its values enter
  // the running sum, and the subtractions by which they will leave it.
  void CountStoring(size_t i) {
    if (!IsNew(i)) return;
    uint64_t sums = 0;
    for (const Integers& plane : values_[i]) {
      sums += 2 * (plane.size() - std::count(plane.begin(), plane.end(), 0));
    }
    counts_.attention_products += sums;
    counts_.attention_bytes += SpikeBytes(config_.ticks, config_.hidden_size) +
                               ValueBytes(config_, config_.ticks, config_.hidden_size) +
                               sums * 2 * sizeof(int16_t);
  }

  // Calls visit(tick) for the ticks of a group.
  template <class Visit>
  void ForEachTick(const Group& group, Visit visit) const {
    for (const int plane : group) {
      for (int n = 0; n < config_.plane_ticks(); ++n) visit(plane * config_.plane_ticks() + n);
    }
  }

  // Returns the number of neurons of a head that fire in both, summed over the ticks of a group.
  int64_t Overlap(const Fired& query, const Fired& key, const Group& group, int head) const {
    int64_t overlap = 0;
    ForEachTick(group, [&](int tick) {
      for (int k = head * config_.head_size(); k < (head + 1) * config_.head_size(); ++k) {
        overlap += query.spikes[tick][k] & key.spikes[tick][k];
      }
    });
    return overlap;
  }

  // Returns whether one of `size` neurons from `first` on fires in a group.
  bool Fires(const Fired& query, const Group& group, int first, int size) const {
    bool fires = false;
    ForEachTick(group, [&](int tick) {
      const auto begin = query.spikes[tick].begin() + first;
      fires |= std::count(begin, begin + size, 1) > 0;
    });
    return fires;
  }
  bool HeadFires(const Fired& query, const Group& group, int head) const {
    return Fires(query, group, head * config_.head_size(), config_.head_size());
  }

  // Returns the weights of the tokens `band`, the last of which asks.
  Row WeighKeys(int layer, const Fired& query, const Group& group, const std::vector<size_t>& band,
                int head, bool is_new) {
    std::vector<int64_t> overlaps;
    for (const size_t j : band) overlaps.push_back(Overlap(query, keys_[j], group, head));
    if (is_new) {
      counts_.softmax_terms += band.size();
      const int ticks = TicksOf(group);
      counts_.attention_bytes += band.size() * (SpikeBytes(ticks, config_.head_size()) +
                                                ValueBytes(config_, ticks, config_.head_size()));
      for (const int64_t overlap : overlaps) counts_.attention_products += overlap;
    }
    const FixedPointLayer& weights = policy_.weights.layers[layer].fixed_point;
    std::vector<int64_t> scores;
    for (const int64_t overlap : overlaps) {
      scores.push_back(weights.attention_scale.values[head] * overlap);
    }
    const int64_t best = *std::max_element(scores.begin(), scores.end());
    Row row;
    for (const int64_t score : scores) {
      const int64_t octaves = RoundShift(best - score, kScaleFraction);
      row.weights.push_back(octaves > 8 ? 0 : 256 >> octaves);
    }
    for (const int64_t weight : row.weights) row.sum += weight;
    return row;
  }

  // Returns the sum of the weighted values of neuron k over the planes of a group. If `is_mean`,
  // the planes have running sums.
  int64_t WeighValues(const Row& row, bool is_mean, const Group& group,
                      const std::vector<size_t>& band, int k, bool is_new) {
    int64_t sum = 0;
    for (const int plane : group) {
      int64_t of_plane = 0;
      for (size_t n = 0; n < band.size(); ++n) {
        const int64_t product = row.weights[n] * values_[band[n]][plane][k];
        of_plane += product;
        if (is_new && !is_mean && product != 0) ++counts_.attention_products;
      }
      if (is_new && is_mean && plane != group.front() && of_plane != 0) {
        ++counts_.attention_products;
      }
      sum += of_plane;
    }
    return sum;
  }

  // Returns y_h of one token, head and group of ticks with kGateFraction fraction bits: [d_h].
  Integers AttendHead(int layer, const Fired& query, const Group& group, size_t i, int head) {
    std::vector<size_t> band;
    for (size_t j = 0; j <= i; ++j) {
      if (IsInBand(i, j)) band.push_back(j);
    }
    // Without weights that are computed, all are 1.
    const bool is_mean = !HeadFires(query, group, head);
    Row row = {std::vector<int64_t>(band.size(), 1), static_cast<int64_t>(band.size())};
    if (!is_mean) {
      row = WeighKeys(layer, query, group, band, head, IsNew(i));
    } else if (IsNew(i)) {
      counts_.attention_bytes +=
          group.size() * static_cast<uint64_t>(config_.head_size()) * sizeof(int16_t);
    }
    Integers y;
    for (int k = head * config_.head_size(); k < (head + 1) * config_.head_size(); ++k) {
      const int64_t sum = WeighValues(row, is_mean, group, band, k, IsNew(i));
      if (IsNew(i) && sum != 0) ++counts_.attention_scalings;
      const int64_t attended = RoundDivide(sum << kGateFraction, row.sum * TicksOf(group));
      y.push_back(static_cast<int32_t>(std::min<int64_t>(attended, kLargestAttended)));
    }
    if (trace_ != nullptr && i + 1 == tokens_.size()) {
      ForEachTick(group, [&](int tick) {
        for (const int64_t weight : row.weights) {
          attention_[tick].push_back(static_cast<float>(weight) / static_cast<float>(row.sum));
        }
      });
    }
    return y;
  }

  // Returns the gates over the heads with kGateFraction fraction bits, [H].
  Integers Gates(const FixedPointLayer& layer, const Integers& y, size_t i) {
    AddMultiplies(i, layer.routing_hidden, y, /*wide=*/false);
    Integers hidden = ApplyMap(layer.routing_hidden, y);
    for (int32_t& h : hidden) h = std::clamp(h, 0, kLargestResidual);
    AddMultiplies(i, layer.routing_gate, hidden, /*wide=*/true);
    Integers gates = ApplyMap(layer.routing_gate, hidden);
    const uint64_t terms = GateScores(config_, gates);
    if (IsNew(i)) counts_.softmax_terms += terms;
    return gates;
  }

  // Adds the heads y [d] of a group, times its ticks and gates, to `sums` [merged_size].
  void AddHeads(int layer, const Integers& y, const Group& group, size_t i,
                std::vector<int64_t>* sums) {
    const int size = config_.head_size();
    const bool concat = config_.merge == Merge::kConcat;
    Integers gates(config_.heads, 1);
    if (config_.has_routing()) {
      gates = Gates(policy_.weights.layers[layer].fixed_point, y, i);
      if (IsNew(i)) counts_.gate_products += y.size();
      ForEachTick(group, [&](int tick) { gates_[tick] = gates; });
    }
    for (int k = 0; k < config_.hidden_size; ++k) {
      (*sums)[concat ? k : k % size] += int64_t{TicksOf(group)} * gates[k / size] * y[k];
    }
  }

  void Attention(int layer, const Fired& query, size_t i) {
    const FixedPointLayer& weights = policy_.weights.layers[layer].fixed_point;
    attention_.assign(config_.ticks, {});
    gates_.assign(config_.ticks, {});
    std::vector<int64_t> sums(config_.merged_size(), 0);
    for (const Group& group : Groups(query)) {
      Integers y;
      for (int head = 0; head < config_.heads; ++head) {
        const Integers part = AttendHead(layer, query, group, i, head);
        y.insert(y.end(), part.begin(), part.end());
      }
      AddHeads(layer, y, group, i, &sums);
    }
    RecordKeys(layer, i);
    RecordAttention(layer, i);
    if (config_.has_routing()) {
      RecordGates(layer, i);
      AddSharedReads(i, weights.routing_hidden);
      AddSharedReads(i, weights.routing_gate);
    }
    const bool concat = config_.merge == Merge::kConcat;
    const int64_t unit = config_.has_routing() ? 1 << kGateFraction : concat ? 1 : config_.heads;
    Integers merged;
    for (const int64_t sum : sums) {
      merged.push_back(static_cast<int32_t>(std::min<int64_t>(
          RoundDivide(config_.gate_factor() * sum, unit * config_.ticks), kLargestAttended)));
    }
    AddMultiplies(i, weights.attention_output, merged, /*wide=*/false);
    AddSharedReads(i, weights.attention_output);
    AddResidual(i, ApplyMap(weights.attention_output, merged), weights.attention_norm);
  }

  void FeedForward(int layer, size_t i) {
    const LayerWeights& weights = policy_.weights.layers[layer];
    const Fired coded = Code(weights.fixed_point.ffn_coder, i);
    const Fired hidden = Fire(weights.integer.ffn_hidden, coded.spikes, i);
    AddSpikes(i, Stage::kFfnIn, layer, coded.spikes);
    AddSpikes(i, Stage::kFfnHidden, layer, hidden.spikes);
    AddMultiplies(i, weights.fixed_point.ffn_output, hidden.counts, /*wide=*/false);
    if (IsNew(i)) {
      counts_.weight_bytes += CountProducts(weights.fixed_point.ffn_output, hidden.counts);
    }
    AddResidual(i, ApplyMap(weights.fixed_point.ffn_output, hidden.counts),
                weights.fixed_point.ffn_norm);
  }

  void AddResidual(size_t i, const Integers& update, const FixedPointNorm& norm) {
    for (size_t k = 0; k < update.size(); ++k) x_[i][k] += update[k];
    NormalizeToken(i, norm, x_[i]);
  }

  void RecordAttention(int layer, size_t i) {
    if (trace_ == nullptr || i + 1 != tokens_.size()) return;
    LayerTrace& trace = trace_->layers[layer];
    for (const std::vector<float>& row : attention_) {
      trace.attention.insert(trace.attention.end(), row.begin(), row.end());
    }
  }

  void RecordGates(int layer, size_t i) {
    if (trace_ == nullptr || !IsRead(i, layer)) return;
    LayerTrace& trace = trace_->layers[layer];
    trace.gated.push_back(Name(i));
    for (const Integers& gates : gates_) {
      for (const int32_t gate : gates) {
        trace.gates.push_back(std::ldexp(static_cast<float>(gate), -kGateFraction));
      }
    }
  }

  std::vector<Integers> x_;                    // the residual stream, [tokens][d]
  std::vector<Fired> keys_;                    // of the current layer, [tokens]
  std::vector<std::vector<Integers>> values_;  // counts of the current layer, [tokens][planes][d]
  std::vector<std::vector<float>> attention_;  // of the last token, [T][H, keys]
  std::vector<Integers> gates_;                // of the current token, [T][H]
};

}  // namespace

void ComputeIntegerReference(const Policy& policy, const PrefixContext& prefix,
                             Engine::Output* output, Trace* trace) {
  IntegerReferencePass(policy, prefix, trace).Run(output);
}

}  // namespace spikeserve
