// The flags for recording data.
#pragma once

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/cli/flag_group.h"
#include "train/recording/record.h"

namespace spikeserve {

inline constexpr char kEnvironmentHelp[] = "Environment, see docs/guides/training.md";

struct RecordFlags {
  RecordOptions options;  // without the student
  std::string student;    // a policy file; empty: none
};

// Adds --expert and --beam_width.
void AddExpertFlags(FlagGroup& group, ExpertOptions* options);

// Adds --tables.
void AddTablesFlag(FlagGroup& group, ExpertOptions* options);

// Adds the flags for the experts and the episodes, except --env, --seed and --tables.
void AddRecordFlags(FlagGroup& group, RecordFlags* flags);

// Returns the options with the student, which it reads from its file. Errors name the file.
absl::StatusOr<RecordOptions> ReadRecordOptions(const RecordFlags& flags);

// Records a dataset. Stores value tables in the directory of `out` unless --tables names another
// directory. Errors name the flag or the file.
absl::StatusOr<Dataset> RecordFromFlags(const RecordFlags& flags, const std::string& out);

// Returns INVALID_ARGUMENT if `out` is empty. `what` describes the value of --out.
absl::Status RequireOut(const std::string& out, absl::string_view what);

// Makes the directory `path` of --out. Returns INVALID_ARGUMENT, which names the flag, if it
// cannot.
absl::Status MakeOutDirectory(const std::string& path);
// The same for the directory of the file `out`.
absl::Status MakeDirectoryOf(const std::string& out);

// Returns `status` with dashes before the name of the field. For options whose fields have the
// names of flags.
absl::Status NameFlag(const absl::Status& status);

}  // namespace spikeserve
