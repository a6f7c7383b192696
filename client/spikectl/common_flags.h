// The flags that every sub-command of spikectl has.
#ifndef CLIENT_SPIKECTL_COMMON_FLAGS_H_
#define CLIENT_SPIKECTL_COMMON_FLAGS_H_

#include <memory>
#include <string>

#include "absl/flags/declare.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "spikeserve/client.h"

ABSL_DECLARE_FLAG(std::string, server);
ABSL_DECLARE_FLAG(bool, json);

namespace spikeserve {

// A client of --server. UNAVAILABLE if it cannot be reached within a few seconds.
absl::StatusOr<std::unique_ptr<Client>> ConnectToServer();

// " (--name, --name)" for names separated by blanks; empty for none.
std::string ListFlags(absl::string_view flags);

// INVALID_ARGUMENT names a flag that was set, belongs to a sub-command, and is not among
// `its_flags`, the names of those of `command`, separated by blanks: it would do nothing.
absl::Status CheckFlags(absl::string_view command, absl::string_view its_flags);

}  // namespace spikeserve

#endif  // CLIENT_SPIKECTL_COMMON_FLAGS_H_
