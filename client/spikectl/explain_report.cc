#include "client/spikectl/explain_report.h"

#include <algorithm>
#include <cstdint>
#include <map>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

constexpr size_t kLineWidth = 100;
constexpr size_t kKeysShown = 5;

constexpr int kMostTicks = 256;
constexpr int kMostHeads = 64;
constexpr int kLargestPopulation = 1 << 16;
const char* const kTokenKinds[] = {"G", "s", "a"};

// Returns INVALID_ARGUMENT unless `holds`.
absl::Status Require(bool holds, absl::string_view field, absl::string_view expected) {
  if (holds) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("explanation: ", field, ": expected ", expected, ", received another answer"));
}

absl::Status CheckToken(const v1::Token& token) {
  return Require(token.kind() >= 0 && token.kind() < 3, "token.kind", "one of three kinds");
}

absl::Status CheckRaster(const v1::SpikeRaster& raster, int ticks) {
  RETURN_IF_ERROR(CheckToken(raster.token()));
  RETURN_IF_ERROR(Require(raster.population() >= 0 && raster.population() <= kLargestPopulation,
                          "rasters.population", "at most 65536 neurons"));
  RETURN_IF_ERROR(Require(raster.ticks_size() == raster.neurons_size(), "rasters",
                          "a tick and a neuron of each spike"));
  for (int i = 0; i < raster.ticks_size(); ++i) {
    const int64_t tick = raster.ticks(i), neuron = raster.neurons(i);
    const bool within = tick >= 0 && tick < ticks && neuron >= 0 && neuron < raster.population();
    RETURN_IF_ERROR(Require(within, "rasters", "spikes of the ticks and of the population"));
  }
  return absl::OkStatus();
}

absl::Status CheckRouting(const v1::RoutingGates& routing, int ticks, int heads) {
  const int64_t expected = int64_t{routing.tokens_size()} * ticks * heads;
  RETURN_IF_ERROR(Require(routing.tokens_size() > 0 && routing.gates_size() == expected,
                          "routing.gates", "one for each token, tick and head"));
  return CheckToken(*routing.tokens().rbegin());
}

absl::Status CheckAttention(const v1::Attention& attention, int heads) {
  for (const v1::Token& key : attention.keys()) RETURN_IF_ERROR(CheckToken(key));
  const bool ticks = attention.ticks() >= 1 && attention.ticks() <= kMostTicks;
  const int64_t expected = int64_t{attention.ticks()} * heads * attention.keys_size();
  return Require(ticks && attention.weights_size() == expected, "attention.weights",
                 "one for each tick, head and key");
}

// Checks every number of a server that is an index or a size below.
absl::Status CheckExplanation(const v1::ExplainResponse& explained) {
  const int64_t ticks = explained.ticks(), heads = explained.heads();
  RETURN_IF_ERROR(Require(ticks >= 1 && ticks <= kMostTicks, "ticks", "1 to 256"));
  RETURN_IF_ERROR(Require(heads >= 1 && heads <= kMostHeads, "heads", "1 to 64"));
  for (const v1::SpikeRaster& raster : explained.rasters()) {
    RETURN_IF_ERROR(CheckRaster(raster, static_cast<int>(ticks)));
  }
  for (const v1::RoutingGates& routing : explained.routing()) {
    RETURN_IF_ERROR(CheckRouting(routing, static_cast<int>(ticks), static_cast<int>(heads)));
  }
  for (const v1::Attention& attention : explained.attention()) {
    RETURN_IF_ERROR(CheckAttention(attention, static_cast<int>(heads)));
  }
  return absl::OkStatus();
}

std::string ToText(const v1::Token& token) {
  return absl::StrCat(kTokenKinds[token.kind()], "_", token.timestep());
}

std::string ToText(const google::protobuf::RepeatedField<float>& numbers) {
  return absl::StrJoin(numbers, " ", [](std::string* out, float number) {
    absl::StrAppendFormat(out, "%.4g", number);
  });
}

using FeatureList = google::protobuf::RepeatedPtrField<v1::Feature>;

// Returns the numbers, each behind its name if there is one for each.
std::string ToText(const google::protobuf::RepeatedField<float>& numbers,
                   const FeatureList& features) {
  if (features.size() != numbers.size()) return ToText(numbers);
  std::vector<std::string> named;
  for (int i = 0; i < numbers.size(); ++i) {
    named.push_back(absl::StrFormat("%s %.4g", features[i].name(), numbers[i]));
  }
  return absl::StrJoin(named, ", ");
}

std::string ToText(const v1::Action& action, const FeatureList& features) {
  if (!action.has_discrete()) return ToText(action.continuous().values(), features);
  const int64_t taken = action.discrete();
  const bool is_named = taken >= 0 && taken < features.size();
  return is_named ? absl::StrCat(taken, " ", features[static_cast<int>(taken)].name())
                  : absl::StrCat(taken);
}

std::string Head(const v1::ExplainResponse& explained, const v1::PolicyInfo& policy) {
  const v1::ActResponse& answer = explained.answer();
  const v1::SpikesByStage& spikes = answer.stats().spikes_by_stage();
  std::string text = absl::StrFormat(
      "%s/%d (%s), session %s, episode %d, step %d\nobservation %s\nreturn-to-go %.6g\naction %s\n"
      "logits %s\n",
      explained.policy(), explained.version(), explained.mode(), explained.session_id(),
      explained.episode(), answer.step(),
      ToText(explained.observation(), policy.observation_features()), answer.return_to_go(),
      ToText(answer.action(), policy.action_features()), ToText(explained.logits()));
  if (!answer.action_probabilities().empty()) {
    absl::StrAppend(&text, "probabilities ", ToText(answer.action_probabilities()), "\n");
  }
  absl::StrAppendFormat(&text,
                        "%d spikes: coder %d, phase %d, query %d, key %d, value %d, ffn_in %d, "
                        "ffn_hidden %d, readout %d\n",
                        answer.stats().spikes(), spikes.coder(), spikes.phase(), spikes.query(),
                        spikes.key(), spikes.value(), spikes.ffn_in(), spikes.ffn_hidden(),
                        spikes.readout());
  const v1::DecisionStats& stats = answer.stats();
  absl::StrAppendFormat(
      &text,
      "%d accumulates, %d multiply-accumulates, %d attention products, %d membrane updates, %d "
      "coder gains, %d LayerNorm elements, %d softmax terms, %d gate products\n",
      stats.accumulates(), stats.multiply_accumulates(), stats.attention_products(),
      stats.membrane_updates(), stats.coder_gains(), stats.layer_norm_elements(),
      stats.softmax_terms(), stats.gate_products());
  return text;
}

std::string RasterToText(const v1::SpikeRaster& raster, int ticks) {
  std::map<int, std::string> cells;  // by neuron, for the neurons that fired
  for (int i = 0; i < raster.ticks_size(); ++i) {
    std::string& cell =
        cells.try_emplace(raster.neurons(i), static_cast<size_t>(ticks), '.').first->second;
    cell[static_cast<size_t>(raster.ticks(i))] = '|';
  }
  std::string text = absl::StrFormat(
      "\n%s%s of %s: %d spikes, %d of %d neurons\n",
      raster.has_layer() ? absl::StrFormat("layer %d ", raster.layer()) : "", raster.stage(),
      ToText(raster.token()), raster.ticks_size(), cells.size(), raster.population());
  size_t width = 0;
  for (const auto& [neuron, cell] : cells) {
    const std::string entry = absl::StrFormat("%6d %s", neuron, cell);
    if (width > 0 && width + entry.size() > kLineWidth) {
      text += '\n';
      width = 0;
    }
    text += entry;
    width += entry.size();
  }
  return text + "\n";
}

// Returns the gates of the last token, averaged over the ticks: one number per head.
std::string RoutingToText(const v1::RoutingGates& routing, int ticks, int heads) {
  std::vector<float> means(static_cast<size_t>(heads), 0.0f);
  const int first = routing.gates_size() - ticks * heads;
  for (int i = 0; i < ticks * heads; ++i) {
    means[static_cast<size_t>(i % heads)] += routing.gates(first + i) / static_cast<float>(ticks);
  }
  return absl::StrFormat("layer %d gates of %s, mean over ticks: %s\n", routing.layer(),
                         ToText(*routing.tokens().rbegin()),
                         absl::StrJoin(means, " ", [](std::string* out, float x) {
                           absl::StrAppendFormat(out, "%.3f", x);
                         }));
}

// Returns the keys with the largest attention weights of a head, averaged over the ticks.
std::string AttentionToText(const v1::Attention& attention, int head, int heads) {
  const int keys = attention.keys_size();
  std::vector<std::pair<float, int>> weights;  // negative, so that sorting puts the largest first
  for (int key = 0; key < keys; ++key) {
    float sum = 0.0f;
    for (int tick = 0; tick < attention.ticks(); ++tick) {
      sum += attention.weights((tick * heads + head) * keys + key);
    }
    weights.emplace_back(-sum / static_cast<float>(attention.ticks()), key);
  }
  std::sort(weights.begin(), weights.end());
  weights.resize(std::min(weights.size(), kKeysShown));
  return absl::StrFormat(
      "layer %d head %d attends most to: %s\n", attention.layer(), head,
      absl::StrJoin(weights, ", ", [&](std::string* out, const std::pair<float, int>& weight) {
        absl::StrAppendFormat(out, "%s %.3f", ToText(attention.keys(weight.second)), -weight.first);
      }));
}

}  // namespace

absl::StatusOr<std::string> ExplainToText(const v1::ExplainResponse& explained,
                                          const v1::PolicyInfo& policy) {
  RETURN_IF_ERROR(CheckExplanation(explained));
  std::string text = Head(explained, policy);
  for (const v1::SpikeRaster& raster : explained.rasters()) {
    if (!raster.ticks().empty()) text += RasterToText(raster, explained.ticks());
  }
  text += '\n';
  for (const v1::RoutingGates& routing : explained.routing()) {
    text += RoutingToText(routing, explained.ticks(), explained.heads());
  }
  for (const v1::Attention& attention : explained.attention()) {
    for (int head = 0; head < explained.heads(); ++head) {
      text += AttentionToText(attention, head, explained.heads());
    }
  }
  return text;
}

}  // namespace spikeserve
