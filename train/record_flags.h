// The flags that say how data are recorded.
#ifndef TRAIN_RECORD_FLAGS_H_
#define TRAIN_RECORD_FLAGS_H_

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/cli/flag_group.h"
#include "train/data/record.h"

namespace spikeserve {

inline constexpr char kEnvironmentHelp[] = "Environment, see docs/training.md";

struct RecordFlags {
  RecordOptions options;  // all but the student
  std::string student;    // a policy file; empty: none
};

// Adds --expert and --beam_width.
void AddExpertFlags(FlagGroup& group, ExpertOptions* options);

// Adds --tables.
void AddTablesFlag(FlagGroup& group, ExpertOptions* options);

// Adds the flags of the experts and of the episodes to record; not --env, --seed and --tables.
void AddRecordFlags(FlagGroup& group, RecordFlags* flags);

// Returns the options with the student read. Errors name the file.
absl::StatusOr<RecordOptions> ReadRecordOptions(const RecordFlags& flags);

// Records a dataset. Value tables are kept beside `out` unless --tables names a directory. Errors
// name the flag or the file.
absl::StatusOr<Dataset> RecordFromFlags(const RecordFlags& flags, const std::string& out);

// INVALID_ARGUMENT if `out` is empty; `what` says what --out names.
absl::Status RequireOut(const std::string& out, absl::string_view what);

// Returns an error of options whose fields have the names of flags, with the flag's dashes.
absl::Status NameFlag(const absl::Status& status);

}  // namespace spikeserve

#endif  // TRAIN_RECORD_FLAGS_H_
