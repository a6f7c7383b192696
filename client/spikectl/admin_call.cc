#include "client/spikectl/admin_call.h"

#include <iostream>
#include <vector>

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_split.h"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

void PrintOne(const ServerFlags& flags, const ServerAnswer& answer) {
  std::cout << (flags.json ? answer.json.dump(2) : answer.text) << "\n";
}

// Returns the row of one server. `shared_by` is the server that has made the change for all, or
// empty.
ordered_json RowOf(const std::string& server, const absl::StatusOr<ServerAnswer>& answer,
                   const std::string& shared_by) {
  ordered_json row = {{"server", server}};
  if (!shared_by.empty()) {
    row["shared_by"] = shared_by;
  } else if (answer.ok()) {
    row.update(answer->json);
  } else {
    row["error"] = answer.status().message();
    row["code"] = absl::StatusCodeToString(answer.status().code());
  }
  return row;
}

std::string TextOf(const absl::StatusOr<ServerAnswer>& answer, const std::string& shared_by) {
  if (!shared_by.empty()) return absl::StrCat("shares what ", shared_by, " has changed");
  if (answer.ok()) return answer->text;
  return absl::StrCat("failed: ", answer.status().message(), " (",
                      absl::StatusCodeToString(answer.status().code()), ")");
}

}  // namespace

absl::Status OnEveryServer(
    const ServerFlags& flags,
    absl::FunctionRef<absl::StatusOr<ServerAnswer>(const ServerFlags&)> call) {
  const std::vector<std::string> servers = absl::StrSplit(flags.server, ',');
  ServerFlags one = flags;
  if (servers.size() == 1) {
    const auto answer = call(one);
    if (answer.ok()) PrintOne(flags, *answer);
    return answer.status();
  }
  ordered_json rows = ordered_json::array();
  std::vector<std::string> failed;
  absl::Status first_error;
  std::string shared_by;
  for (const std::string& address : servers) {
    one.server = std::string(absl::StripAsciiWhitespace(address));
    absl::StatusOr<ServerAnswer> answer = ServerAnswer();
    if (shared_by.empty()) answer = call(one);
    if (flags.json) {
      rows.push_back(RowOf(one.server, answer, shared_by));
    } else {
      std::cout << one.server << ": " << TextOf(answer, shared_by) << std::endl;
    }
    if (!answer.ok()) {
      failed.push_back(one.server);
      first_error.Update(answer.status());
    } else if (answer->shared) {
      shared_by = one.server;
    }
  }
  if (flags.json) std::cout << ordered_json{{"servers", rows}}.dump(2) << "\n";
  if (failed.empty()) return absl::OkStatus();
  return absl::Status(first_error.code(),
                      absl::StrCat(failed.size(), " of ", servers.size(), " servers failed: ",
                                   absl::StrJoin(failed, ", "), ": ", first_error.message()));
}

}  // namespace spikeserve
