// Policy files: every file is refused, or makes decisions that are finite or refused.
#include <cmath>
#include <filesystem>
#include <memory>

#include "core/base/file.h"
#include "core/engine/factory/engine_factory.h"
#include "core/model/policy_file.h"
#include "core/quantize/quantize_integer.h"
#include "tests/fuzz/fuzz_target.h"
#include "tests/support/small_policy.h"

namespace spikeserve {
namespace {

// Bounds the time of one input: a valid file may ask for a large model.
constexpr int64_t kMaxWork = 1 << 16;

std::string BytesOf(const Policy& policy) {
  const std::filesystem::path path = std::filesystem::temp_directory_path() / "fuzz.safetensors";
  FUZZ_CHECK(WritePolicyFile(policy, path.string()).ok());
  std::string bytes = *ReadFile(path.string());
  std::filesystem::remove(path);
  return bytes;
}

}  // namespace

void FuzzOne(absl::string_view input) {
  auto policy = ParsePolicyFile(input);
  if (!policy.ok()) {
    FUZZ_CHECK(!policy.status().message().empty());
    return;
  }
  const ModelConfig& config = policy->config;
  if (int64_t{config.hidden_size} * config.ticks * config.layers > kMaxWork) return;
  const auto shared = std::make_shared<const Policy>(*std::move(policy));
  const auto engine = MakeEngine(shared);
  const std::vector<float> observation(static_cast<size_t>(shared->observation_size()), 1.0f);
  const auto context = engine->NewContext();
  Engine::Output output;
  for (int step = 0; step < 3; ++step) {
    engine->Decide(*context, shared->target_return, observation, &output);
  }
}

std::vector<std::string> Seeds() {
  std::vector<std::string> seeds;
  for (const Mode mode : {Mode::kDense, Mode::kBaseline, Mode::kFull}) {
    ModelConfig config = SmallConfig(mode);
    config.hidden_size = 8;
    config.ffn_size = 8;
    config.layers = 1;
    Policy policy = SmallPolicy(config);
    seeds.push_back(BytesOf(policy));
    if (mode == Mode::kDense) {
      // Finite weights whose products are not: the softmax of the attention is NaN.
      LayerWeights& layer = policy.weights.layers[0];
      for (float& weight : layer.query.weight.values) weight *= 1e30f;
      for (float& weight : layer.key.weight.values) weight *= 1e30f;
      seeds.push_back(BytesOf(policy));
      continue;
    }
    if (const auto quantized = QuantizeToInteger(policy); quantized.ok()) {
      seeds.push_back(BytesOf(*quantized));
    }
  }
  return seeds;
}

}  // namespace spikeserve
