// The servers that an operator calls: all at once, or the one that has a session.
//
// Not thread-safe; AtEach() calls the servers from threads of its own.
#pragma once

#include <memory>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "client/spikectl/admin_call.h"
#include "client/spikectl/server_flags.h"

namespace spikeserve {

class OperatorServers {
 public:
  static constexpr absl::Duration kTimeout = absl::Seconds(2);  // of a call

  // The servers of --server. Connects with the first call.
  explicit OperatorServers(const ServerFlags& flags);

  size_t size() const { return servers_.size(); }
  const std::string& address(size_t i) const { return servers_[i].flags.server; }

  // Calls every server at once, so that none waits for another one, and returns their answers.
  // `request` returns the request for server i.
  template <typename Request, typename Response>
  std::vector<absl::StatusOr<Response>> AtEach(
      grpc::Status (AdminStub::*method)(grpc::ClientContext*, const Request&, Response*),
      absl::FunctionRef<Request(size_t i)> request, absl::Duration timeout = kTimeout) {
    std::vector<absl::StatusOr<Response>> answers(servers_.size());
    std::vector<std::thread> threads;
    for (size_t i = 0; i < servers_.size(); ++i) {
      threads.emplace_back([&, i] { answers[i] = Call(servers_[i], method, request(i), timeout); });
    }
    for (std::thread& thread : threads) thread.join();
    return answers;
  }

  // Calls the server that has the session of `request`: the one that had it last, then the others.
  // NOT_FOUND if all say that they have not.
  template <typename Request, typename Response>
  absl::StatusOr<Response> OfSession(grpc::Status (AdminStub::*method)(grpc::ClientContext*,
                                                                       const Request&, Response*),
                                     const Request& request) {
    absl::Status failure = absl::NotFoundError("session_id: expected a session of a server");
    for (size_t k = 0; k < servers_.size(); ++k) {
      const size_t i = (owner_ + k) % servers_.size();
      auto answer = Call(servers_[i], method, request);
      const absl::Status& status = answer.status();
      if (answer.ok()) owner_ = i;
      if (!absl::IsNotFound(status) && !absl::IsUnavailable(status) &&
          !absl::IsDeadlineExceeded(status)) {
        return answer;
      }
      if (absl::IsNotFound(failure)) failure = status;  // one that is away may have the session
    }
    return failure;
  }

 private:
  struct Server {
    ServerFlags flags;  // with its address alone
    std::unique_ptr<AdminClient> admin = nullptr;
  };

  template <typename Method, typename Request>
  static auto Call(Server& server, Method method, const Request& request,
                   absl::Duration timeout = kTimeout)
      -> decltype(server.admin->Call(method, request)) {
    if (server.admin == nullptr) {
      auto admin = ConnectAdmin(server.flags);
      if (!admin.ok()) return admin.status();
      server.admin = *std::move(admin);
    }
    return server.admin->Call(method, request, timeout);
  }

  std::vector<Server> servers_;
  size_t owner_ = 0;  // of the session of OfSession()
};

}  // namespace spikeserve
