// Flags that several subcommands share.
#ifndef TRAIN_COMMON_FLAGS_H_
#define TRAIN_COMMON_FLAGS_H_

#include <cstdint>
#include <string>

#include "absl/flags/declare.h"
#include "absl/status/statusor.h"
#include "absl/types/optional.h"
#include "train/data/record.h"
#include "train/evaluation/evaluation.h"

ABSL_DECLARE_FLAG(absl::optional<std::string>, env);
ABSL_DECLARE_FLAG(absl::optional<uint64_t>, seed);
ABSL_DECLARE_FLAG(std::string, out);
ABSL_DECLARE_FLAG(bool, json);
ABSL_DECLARE_FLAG(int, episodes);

namespace spikeserve {

// The expert that --env, --expert, --tables and --beam_width ask for.
ExpertOptions ExpertOptionsFromFlags();

// The recipe that the flags of the expert, --seed, --steps, the fractions and the bursts ask for.
absl::StatusOr<RecordOptions> RecordOptionsFromFlags();

// INVALID_ARGUMENT if --out is missing; `what` says what it should name.
absl::StatusOr<std::string> RequiredOut(absl::string_view what);

// Writes one evaluation to standard output, as JSON with --json.
void PrintEvaluation(const Evaluation& evaluation, const ModelConfig& config);

}  // namespace spikeserve

#endif  // TRAIN_COMMON_FLAGS_H_
