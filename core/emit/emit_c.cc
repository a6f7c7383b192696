#include "core/emit/emit_c.h"

#include <algorithm>
#include <bit>
#include <cstdlib>

#include "absl/status/status.h"
#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_replace.h"
#include "core/base/json.h"
#include "core/base/printable.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/digest/sha256.h"
#include "core/emit/fixed_sources.h"
#include "core/emit/policy_tables.h"
#include "core/engine/engine.h"
#include "core/model/policy_file.h"

namespace spikeserve {
namespace {

constexpr int kTextBytes = 320;       // at most 117 of a session that opens, and its policy's name
constexpr size_t kLongestName = 128;  // as that of a server
constexpr int kEndBytes = 160;        // without the numbers of an observation and an action
constexpr int kNumberBytes = 5;       // in CBOR
constexpr int kCostsBytes = 23 * 4;

int64_t RoundUp(int64_t value, int64_t unit) { return (value + unit - 1) / unit * unit; }

// The size of spike_state (c/spike_policy.h), which is equal on every processor.
struct StateSize {
  int word_bits = 32;       // of spike_word: the widest that a head fills, of 8, 16 and 32
  int words = 1;            // of a head at a tick
  int widest = 0;           // the most inputs or outputs of a map or a population
  int text_bytes = 0;       // of a session's labels and ids
  int end_bytes = 0;        // of the end of an episode
  int64_t state_bytes = 0;  // of all
};

StateSize StateSizeOf(const Policy& policy) {
  const ModelConfig& config = policy.config;
  const int64_t d = config.hidden_size;
  const int64_t observations = policy.observation_size();
  const int64_t actions = policy.action_space.size();
  const int64_t slots = int64_t{3} * config.context;
  StateSize size;
  const int head = config.head_size();
  size.word_bits = head % 32 == 0 ? 32 : head % 16 == 0 ? 16 : 8;
  size.words = (head + size.word_bits - 1) / size.word_bits;
  size.widest = std::max(
      {config.hidden_size, config.ffn_size, config.has_routing() ? config.routing_hidden_size : 0,
       config.state_inputs(policy.observation_size()), policy.action_space.size()});
  size.text_bytes = kTextBytes;

  const int64_t action = 4 * (policy.action_space.is_discrete() ? 1 : actions);
  const int64_t words = int64_t{size.words} * config.ticks * config.heads;
  int64_t bytes = 10 * 8 + 11 * 4 + 4 + 2 * kCostsBytes + 4 + 4 * actions + action +
                  4 * actions * d + HistorySize(config) * (4 + 4 * observations + action);
  // x, sums, weights, gates, merged
  bytes += 4 * (d + size.widest + slots + config.heads + config.merged_size());
  bytes += words * size.word_bits / 8 * (2 * config.layers * slots + 1);  // keys, values, query
  bytes = RoundUp(bytes, 2) + 2 * (size.widest + int64_t{config.ticks} * size.widest);
  bytes += d + size.text_bytes;
  size.state_bytes = RoundUp(bytes + kEndBytes + kNumberBytes * (observations + actions), 8);
  size.end_bytes = static_cast<int>(size.state_bytes - bytes);
  return size;
}

// Returns the largest number that attention may compute, which the C holds in 32 bits.
int64_t LargestOfAttention(const Policy& policy) {
  const ModelConfig& config = policy.config;
  const int64_t keys = int64_t{3} * config.context;
  const int64_t overlap = int64_t{config.plane_ticks()} * config.head_size();
  int64_t scale = 0;
  for (const LayerWeights& layer : policy.weights.layers) {
    for (const int16_t value : layer.fixed_point.attention_scale.values) {
      scale = std::max<int64_t>(scale, std::abs(int64_t{value}));
    }
  }
  // A row is divided by RoundDivide(256 * sum of weights * counts, T * sum of weights).
  return std::max(2 * scale * overlap, int64_t{513} * config.ticks * 256 * keys);
}

absl::Status Check(const Policy& policy, const EmitOptions& options, int64_t state_bytes) {
  if (options.name.size() > kLongestName || !IsPrintable(options.name)) {
    return InvalidArgument(
        "name", absl::StrCat("at most ", kLongestName, " bytes of printable characters"),
        absl::StrCat(Quoted(options.name), " of ", options.name.size(), " bytes"));
  }
  if (policy.config.arithmetic != Arithmetic::kInteger) {
    return absl::FailedPreconditionError(absl::StrCat(
        "policy: expected the arithmetic integer, received ", ToString(policy.config.arithmetic),
        "; convert it first: spiketrain quantize --policy=FILE --to=integer --out=FILE"));
  }
  if (policy.config.is_dense()) {
    return absl::FailedPreconditionError("policy: expected a spiking mode, received dense");
  }
  if (const int64_t largest = LargestOfAttention(policy); largest > INT32_MAX) {
    return absl::FailedPreconditionError(
        absl::StrCat("policy: expected sums of attention of at most 31 bits, received up to ",
                     largest, "; a shorter context or fewer ticks make them smaller"));
  }
  if (options.most_state > 0 && state_bytes > options.most_state) {
    return absl::FailedPreconditionError(
        absl::StrCat("--ram: expected at least ", state_bytes, " bytes for the state, received ",
                     options.most_state, "; a shorter context needs less"));
  }
  return absl::OkStatus();
}

std::string Banner(const Policy& policy, const EmitOptions& options) {
  // A text of others must not end the comment.
  const auto in_comment = [](const std::string& text) {
    return absl::StrReplaceAll(text, {{"*", "_"}});
  };
  return absl::StrCat(
      "/* The policy ", in_comment(options.name), ", version ", options.version, ", for ",
      policy.environment.empty() ? "an environment without a name" : in_comment(policy.environment),
      ".\n   Made by `spikectl emit-c`; do not edit. It decides as spikeserve does, bit for bit.\n"
      "   SPDX-License-Identifier: Apache-2.0 */\n");
}

// Returns the sizes of the policy as macros.
std::string Sizes(const Policy& policy, const EmitOptions& options, absl::string_view sha256,
                  const StateSize& size) {
  const ModelConfig& config = policy.config;
  std::string text;
  const auto define = [&text](absl::string_view name, const auto& value) {
    absl::StrAppend(&text, "#define SPIKE_", name, " ", value, "\n");
  };
  define("POLICY", absl::StrCat("\"", absl::CEscape(options.name), "\""));
  define("VERSION", options.version);
  define("SHA256", absl::StrCat("\"", sha256, "\""));
  define("OBSERVATIONS", policy.observation_size());
  define("ACTIONS", policy.action_space.size());
  define("DISCRETE", int{policy.action_space.is_discrete()});
  define("TARGET_RETURN", CNumber(double{policy.target_return}));
  define("STATE_BYTES", size.state_bytes);
  define("HIDDEN", config.hidden_size);
  define("HEADS", config.heads);
  define("HEAD_SIZE", config.head_size());
  define("LAYERS", config.layers);
  define("TICKS", config.ticks);
  define("CONTEXT", config.context);
  define("HISTORY", HistorySize(config));
  define("WIDEST", size.widest);
  define("MERGED", config.merged_size());
  define("CONCAT", int{config.merge == Merge::kConcat});
  define("ROUTING", int{config.has_routing()});
  define("ROUTING_HIDDEN", config.has_routing() ? config.routing_hidden_size : 0);
  define("GATE_FACTOR", config.gate_factor());
  define("SIGMOID", int{config.gate == Gate::kSigmoid});
  define("PHASES", int{config.has_phase()});
  define("NORMS", int{config.has_norms()});
  define("CHANGES", int{config.observation_changes});
  define("LEAKED(v)", absl::StrCat("(((v) * ", config.leak(), " + 128) >> 8)"));
  define("BY_TICK", int{config.attention == AttentionTicks::kByTick});
  define("INPUT_UNIT", absl::StrCat(1 << config.input_fraction, ".0f"));
  define("RETURN_OFFSET", CNumber(policy.return_offset));
  define("RETURN_SCALE", CNumber(policy.return_scale));
  // Of the thresholds that a coder compares.
  define("CODER_BYTES", 2 * std::bit_width(static_cast<unsigned>(config.ticks)));
  define("WORD_BITS", size.word_bits);
  define("WORDS", size.words);
  define("TEXT_BYTES", size.text_bytes);
  define("END_BYTES", size.end_bytes);
  return text;
}

}  // namespace

absl::StatusOr<EmittedC> EmitC(absl::string_view policy_file, const EmitOptions& options) {
  ASSIGN_OR_RETURN(const Policy policy, ParsePolicyFile(policy_file));
  const StateSize size = StateSizeOf(policy);
  RETURN_IF_ERROR(Check(policy, options, size.state_bytes));
  const auto& fixed = FixedSources();
  const PolicyTables tables = TablesOf(policy);
  EmittedC emitted;
  emitted.table_bytes = tables.bytes;
  emitted.state_bytes = size.state_bytes;
  emitted.header =
      absl::StrCat(Banner(policy, options), "#ifndef SPIKE_POLICY_H_\n#define SPIKE_POLICY_H_\n\n",
                   "#include <stdint.h>\n\n", Sizes(policy, options, Sha256Of(policy_file), size),
                   "typedef uint", size.word_bits, "_t spike_word;\n", fixed.at("spike_policy.h"),
                   "\n#endif /* SPIKE_POLICY_H_ */\n");
  emitted.source = absl::StrCat(Banner(policy, options),
                                "#if defined(__GNUC__) && !defined(__clang__)\n#pragma GCC "
                                "optimize(\"fp-contract=off\")\n#else\n"
                                "#pragma STDC FP_CONTRACT OFF\n#endif\n\n#include "
                                "\"spike_policy.h\"\n\n#include <string.h>\n\n",
                                fixed.at("network.c"), "\n", tables.text, fixed.at("stages.c"),
                                fixed.at("attention.c"), fixed.at("head.c"), fixed.at("session.c"),
                                fixed.at("value_writer.c"), fixed.at("value_reader.c"));
  return emitted;
}

}  // namespace spikeserve
