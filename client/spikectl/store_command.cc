#include <algorithm>
#include <iostream>
#include <memory>
#include <string>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/strip.h"
#include "client/spikectl/commands.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/store/redis_options.h"
#include "core/store/store_reader.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

// The most findings of a kind that the text shows; --json shows all.
constexpr size_t kMostFindings = 20;

struct StoreFlags {
  std::string address;
  std::string user;
  std::string password_file;
  absl::Duration timeout = kDefaultRedisTimeout;
  RedisTlsFiles tls_files;
};

absl::StatusOr<StoreReport> Check(const StoreFlags& flags) {
  absl::string_view folder = flags.address;
  if (absl::ConsumePrefix(&folder, "file:") && !folder.empty()) {
    return CheckFileStore(std::string(folder));
  }
  RETURN_IF_ERROR(CheckNoRedisPassword(flags.address));
  auto address = ParseRedisAddress(flags.address);
  if (!address.has_value()) {
    return absl::InvalidArgumentError(absl::StrCat("expected file:DIR, ", kRedisAddressForms,
                                                   ", received ", Quoted(flags.address)));
  }
  RedisOptions options = {
      .address = *std::move(address), .timeout = flags.timeout, .tls_files = flags.tls_files};
  if (!flags.user.empty()) options.address.user = flags.user;
  options.password_file = flags.password_file;
  RETURN_IF_ERROR(ReadRedisPassword(flags.password_file).status());
  return CheckRedisStore(options);
}

ordered_json ToJson(const std::vector<StoreFinding>& findings) {
  ordered_json json = ordered_json::array();
  for (const StoreFinding& finding : findings) {
    json.push_back({{"name", finding.name}, {"reason", finding.reason}});
  }
  return json;
}

ordered_json ToJson(const StoreReport& report) {
  return {{"open", report.open},
          {"closed", report.closed},
          {"owned", report.owned},
          {"ownerless", report.ownerless},
          {"entries", report.entries},
          {"bytes", report.bytes},
          {"replicas", report.replicas},
          {"damaged", ToJson(report.damaged)},
          {"orphaned", ToJson(report.orphaned)},
          {"warnings", report.warnings}};
}

void AppendFindings(const char* kind, const std::vector<StoreFinding>& findings,
                    std::string* text) {
  for (size_t i = 0; i < std::min(findings.size(), kMostFindings); ++i) {
    absl::StrAppend(text, "\n", kind, ": ", findings[i].name, ": ", findings[i].reason);
  }
  if (findings.size() > kMostFindings) {
    absl::StrAppend(text, "\n", kind, ": ", findings.size() - kMostFindings, " more; see --json");
  }
}

std::string ToText(const StoreReport& report) {
  std::string text = absl::StrCat(
      report.open, " open sessions, of which ", report.owned, " have a living owner; ",
      report.closed, " closed; ", report.entries, " decisions after the snapshots; ", report.bytes,
      " bytes; ", report.damaged.size(), " damaged, ", report.orphaned.size(), " orphaned");
  if (!report.replicas.empty()) {
    absl::StrAppend(&text, "\nservers: ", absl::StrJoin(report.replicas, " "));
  }
  AppendFindings("damaged", report.damaged, &text);
  AppendFindings("orphaned", report.orphaned, &text);
  for (const std::string& warning : report.warnings) absl::StrAppend(&text, "\nwarning: ", warning);
  return text;
}

absl::Status RunCheck(const StoreFlags& flags, bool json) {
  const auto report = Check(flags);
  if (!report.ok()) return Annotate(report.status(), "--session_store");
  std::cout << (json ? ToJson(*report).dump(2) : ToText(*report)) << "\n";
  if (report->damaged.empty() && report->orphaned.empty()) return absl::OkStatus();
  return absl::DataLossError(
      absl::StrCat("session store: expected no damaged session and no orphaned part, received ",
                   report->damaged.size(), " and ", report->orphaned.size()));
}

}  // namespace

void AddStoreCommands(Command program, const ServerFlags& server) {
  const Command store = program.AddCommand("store", "Inspects a session store");
  const Command check = store.AddCommand("check", "Reads every journal and says what is wrong");
  const auto flags = std::make_shared<StoreFlags>();
  check.Flags("Store")
      .Add("session_store", "STORE", &flags->address, "As of the server: file:DIR, redis://HOST")
      .Add("store_user", "NAME", &flags->user,
           "User of Redis; empty: as the address says, or the default user")
      .Add("store_password_file", "FILE", &flags->password_file, "Password of Redis")
      .Add("store_timeout", "DURATION", &flags->timeout, "Time that Redis may take to answer")
      .Add("store_ca", "FILE", &flags->tls_files.ca,
           "PEM authorities of Redis over TLS; empty: those of the system")
      .Add("store_certificate", "FILE", &flags->tls_files.certificate,
           "PEM client certificate for Redis")
      .Add("store_key", "FILE", &flags->tls_files.key, "PEM private key of the former");
  check.SetAction([flags, &server] { return RunCheck(*flags, server.json); });
}

}  // namespace spikeserve
