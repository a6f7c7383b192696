// Makes statuses, and adds context to their messages.
//
// All functions are pure and thread-safe.
#pragma once

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns INVALID_ARGUMENT with the message "`field`: expected `expected`, received `received`".
//
//   InvalidArgument("--validation", "0 or more, below 1", flags.validation)
absl::Status InvalidArgument(const absl::AlphaNum& field, const absl::AlphaNum& expected,
                             const absl::AlphaNum& received);

// Returns `status` with "`prefix`: " added before its message, and with the same code and payloads.
// Returns OK unchanged.
//
//   Annotate(absl::NotFoundError("no such file"), "--tokens")  // "--tokens: no such file"
absl::Status Annotate(const absl::Status& status, absl::string_view prefix);

// Returns errno as a status with the message "`path`: cannot `what`: " and the system's text.
absl::Status SystemError(absl::string_view what, absl::string_view path);

}  // namespace spikeserve
