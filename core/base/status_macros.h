// Early returns of a status. For source files: no header of ours includes this one.
#pragma once

#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

// Returns the absl::Status of an expression from the function, unless it is OK.
#define RETURN_IF_ERROR(...)                                             \
  do {                                                                   \
    if (absl::Status early_status = (__VA_ARGS__); !early_status.ok()) { \
      return early_status;                                               \
    }                                                                    \
  } while (false)

// Assigns the value of an expression, an absl::StatusOr, to `lhs`, which may declare a variable, or
// returns its status from the function.
#define ASSIGN_OR_RETURN(lhs, ...) \
  ASSIGN_OR_RETURN_IMPL(STATUS_MACROS_CONCAT(status_or_, __LINE__), lhs, __VA_ARGS__)

#define ASSIGN_OR_RETURN_IMPL(status_or, lhs, ...)           \
  auto status_or = (__VA_ARGS__);                            \
  if (!status_or.ok()) return std::move(status_or).status(); \
  lhs = *std::move(status_or)

#define STATUS_MACROS_CONCAT(a, b) STATUS_MACROS_CONCAT_IMPL(a, b)
#define STATUS_MACROS_CONCAT_IMPL(a, b) a##b
