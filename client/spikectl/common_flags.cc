#include "client/spikectl/common_flags.h"

#include <string>
#include <utility>
#include <vector>

#include "absl/algorithm/container.h"
#include "absl/flags/flag.h"
#include "absl/flags/reflection.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_replace.h"
#include "absl/strings/str_split.h"
#include "client/tools/security_flags.h"

ABSL_FLAG(std::string, server, "127.0.0.1:50051", "HOST:PORT of the server");
ABSL_FLAG(bool, json, false, "Print one JSON object instead of text");

namespace spikeserve {

absl::StatusOr<std::unique_ptr<Client>> ConnectToServer() {
  ClientOptions options;
  auto security = SecurityFromFlags();
  if (!security.ok()) return security.status();
  options.security = *std::move(security);
  return Client::Connect(absl::GetFlag(FLAGS_server), std::move(options));
}

std::string ListFlags(absl::string_view flags) {
  if (flags.empty()) return "";
  return absl::StrCat(" (--", absl::StrReplaceAll(flags, {{" ", ", --"}}), ")");
}

absl::Status CheckFlags(absl::string_view command, absl::string_view its_flags) {
  const std::vector<absl::string_view> known = absl::StrSplit(its_flags, ' ', absl::SkipEmpty());
  for (const auto& [name, flag] : absl::GetAllFlags()) {
    const bool of_some_command = absl::StrContains(flag->Filename(), "client/spikectl/") &&
                                 !absl::EndsWith(flag->Filename(), "common_flags.cc");
    const bool is_set = flag->CurrentValue() != flag->DefaultValue();
    if (!of_some_command || !is_set || absl::c_linear_search(known, name)) continue;
    return absl::InvalidArgumentError(absl::StrCat("--", name, ": expected a flag that ", command,
                                                   " has", ListFlags(its_flags), ", received ",
                                                   flag->CurrentValue()));
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
