// Functions that the actions of `spikectl admin` share. Every action makes one call of PolicyAdmin
// with the values of its flags, and returns the answer of one server. OnEveryServer prints the rows
// of several; not thread-safe.
#pragma once

#include <grpcpp/client_context.h>

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/spikectl/server_flags.h"
#include "nlohmann/json.hpp"
#include "spikeserve/admin_client.h"
#include "spikeserve/v1/policy_admin.grpc.pb.h"

namespace spikeserve {

using AdminStub = v1::PolicyAdmin::Stub;

// The flags of all actions. Each action uses some of them.
struct AdminFlags {
  const ServerFlags* server = nullptr;
  const ServerFlags* servers = nullptr;  // all of them
  std::string policy;
  int64_t version = 0;
  std::string file;                  // policy file to push, or to write
  std::string signature;             // file of its signature; empty: FILE.sig if there is one
  std::vector<std::string> rollout;  // percentages of the roll-out of a pushed version
  std::string tenant;                // whose head or share; empty: the caller's tenant
  std::string label;                 // a label of a version, such as stable
  std::vector<std::string> shares;   // VERSION:PERCENT: shares of the new sessions
  std::optional<int64_t> shadow;     // the version that shadows the others; 0: none
  bool make_default = false;         // also makes a loaded version the default
  std::vector<std::string> steps = {"1", "10", "50", "100"};  // percentages of a roll-out
  absl::Duration hold = absl::Minutes(10);                    // time that each step is held
  int64_t min_episodes = 20;                                  // of the new version in each step
  // MEASURE:PERCENT%: what ends a roll-out. Sent in full, so that the history has them.
  std::vector<std::string> abort_if = {"return:0%", "errors:1%", "p99:25%"};
  std::string require_ope;  // file of `spiketrain ope --json` that must admit the roll-out
  bool abort = false;       // ends the running roll-out
  bool by_need = false;     // lists sessions that need help, the neediest first
  int32_t limit = 20;       // entries of the history
  bool cancel = false;      // ends draining: the version accepts new sessions again
  std::string month;        // such as 2026-11; empty: the running one
  std::vector<std::string> by = {"tenant", "policy"};  // what rows of usage are told apart by
  bool csv = false;                                    // prints usage as comma-separated values
  bool weights = false;                                // also prints the weights of the head
  std::string session;                                 // with a head of its own
  std::string operator_id;                             // whose corrections
  absl::Duration last = absl::Minutes(1);              // how far back corrections are undone
};

template <typename Request, typename Response>
absl::StatusOr<Response> CallAdmin(const AdminFlags& flags,
                                   grpc::Status (AdminStub::*method)(grpc::ClientContext*,
                                                                     const Request&, Response*),
                                   const Request& request) {
  const auto admin = ConnectAdmin(*flags.server);
  if (!admin.ok()) return admin.status();
  return (*admin)->Call(method, request);
}

// Returns a request with the values of --policy and --version.
template <typename Request>
Request VersionRequest(const AdminFlags& flags) {
  Request request;
  request.set_policy(flags.policy);
  request.set_version(flags.version);
  return request;
}

// As VersionRequest, and with the value of --tenant.
template <typename Request>
Request HeadRequest(const AdminFlags& flags) {
  auto request = VersionRequest<Request>(flags);
  request.set_tenant(flags.tenant);
  return request;
}

// What a command has to print about one server.
struct ServerAnswer {
  std::string text;
  nlohmann::ordered_json json;
  // All servers with the same store do what this one has done.
  bool shared = false;
};

// Calls `call` with the flags for one server after the other, and prints its answers: that of a
// single server as it is; those of several as rows that begin with the address, or as the list
// "servers" of a JSON object. After an answer that is `shared`, no other server is called. Returns
// OK if every server did it; otherwise an error that counts and names those that did not.
absl::Status OnEveryServer(
    const ServerFlags& flags,
    absl::FunctionRef<absl::StatusOr<ServerAnswer>(const ServerFlags&)> call);

}  // namespace spikeserve
