#include "spikeserve/channel.h"

#include <grpcpp/create_channel.h>
#include <grpcpp/security/credentials.h>
#include <grpcpp/support/channel_arguments.h>
#include <grpcpp/support/client_interceptor.h>

#include <algorithm>
#include <climits>
#include <cstdint>
#include <fstream>
#include <sstream>
#include <utility>
#include <vector>

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

namespace interception = grpc::experimental;

constexpr int kLargestMessage = 1 << 28;  // a policy file may be large

// Adds the token to a call. gRPC refuses to send call credentials in plain text, which a server on
// the loopback interface uses, so the token is added as metadata.
class TokenInterceptor final : public interception::Interceptor {
 public:
  explicit TokenInterceptor(const std::string& header) : header_(header) {}

  void Intercept(interception::InterceptorBatchMethods* methods) override {
    using interception::InterceptionHookPoints;
    if (methods->QueryInterceptionHookPoint(InterceptionHookPoints::PRE_SEND_INITIAL_METADATA)) {
      methods->GetSendInitialMetadata()->emplace("authorization", header_);
    }
    methods->Proceed();
  }

 private:
  const std::string& header_;  // owned by the factory, which outlives every call
};

class TokenInterceptorFactory final : public interception::ClientInterceptorFactoryInterface {
 public:
  explicit TokenInterceptorFactory(const std::string& token)
      : header_(absl::StrCat("Bearer ", token)) {}

  interception::Interceptor* CreateClientInterceptor(interception::ClientRpcInfo*) override {
    return new TokenInterceptor(header_);  // gRPC takes ownership
  }

 private:
  const std::string header_;
};

absl::StatusOr<std::string> ReadTextFile(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::ostringstream text;
  if (!file || !(text << file.rdbuf())) {
    return absl::NotFoundError(absl::StrCat("cannot read ", path));
  }
  return std::move(text).str();
}

absl::StatusOr<std::shared_ptr<grpc::ChannelCredentials>> MakeCredentials(
    const SecurityOptions& security) {
  if (!security.use_tls()) return grpc::InsecureChannelCredentials();
  if (security.certificate.empty() != security.key.empty()) {
    return absl::InvalidArgumentError(
        "certificate and key: expected both or neither, received one");
  }
  grpc::SslCredentialsOptions options;
  const std::pair<const std::string*, std::string*> files[] = {
      {&security.ca, &options.pem_root_certs},
      {&security.certificate, &options.pem_cert_chain},
      {&security.key, &options.pem_private_key}};
  for (const auto& [path, pem] : files) {
    if (path->empty()) continue;
    auto text = ReadTextFile(*path);
    if (!text.ok()) return text.status();
    *pem = *std::move(text);
  }
  return grpc::SslCredentials(options);
}

int Milliseconds(absl::Duration duration) {
  return static_cast<int>(std::clamp<int64_t>(absl::ToInt64Milliseconds(duration), 1, INT_MAX));
}

}  // namespace

absl::StatusOr<std::string> ReadTokenFile(const std::string& path) {
  const auto text = ReadTextFile(path);
  if (!text.ok()) return text.status();
  return std::string(absl::StripAsciiWhitespace(*text));
}

absl::StatusOr<std::shared_ptr<grpc::Channel>> MakeChannel(const std::string& server,
                                                           const SecurityOptions& security) {
  // gRPC ends the process for metadata with other characters.
  if (!std::all_of(security.token.begin(), security.token.end(), absl::ascii_isprint)) {
    return absl::InvalidArgumentError(
        "token: expected printable ASCII characters, received others");
  }
  const auto credentials = MakeCredentials(security);
  if (!credentials.ok()) return credentials.status();
  grpc::ChannelArguments arguments;
  // By default gRPC shares one connection between all channels to the same server.
  arguments.SetInt(GRPC_ARG_USE_LOCAL_SUBCHANNEL_POOL, 1);
  // The client repeats calls by itself, and knows which ones it may repeat.
  arguments.SetInt(GRPC_ARG_ENABLE_RETRIES, 0);
  // Reconnects to a restarted server within a third of a second, not up to two minutes.
  arguments.SetInt(GRPC_ARG_INITIAL_RECONNECT_BACKOFF_MS, 100);
  arguments.SetInt(GRPC_ARG_MAX_RECONNECT_BACKOFF_MS, 300);
  // An attempt to connect ends after two seconds, not twenty: SYN packets are repeated ever later.
  arguments.SetInt(GRPC_ARG_MIN_RECONNECT_BACKOFF_MS, 2000);
  // While a call is under way, a silent server is asked for a sign of life. gRPC sets
  // TCP_USER_TIMEOUT to the timeout.
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIME_MS, Milliseconds(security.keepalive));
  arguments.SetInt(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, Milliseconds(security.keepalive_timeout));
  // Newer releases of gRPC wait for the answer to a PING for a minute unless told otherwise.
  arguments.SetInt("grpc.http2.ping_timeout_ms", Milliseconds(security.keepalive_timeout));
  arguments.SetInt(GRPC_ARG_HTTP2_MAX_PINGS_WITHOUT_DATA, 0);
  arguments.SetMaxReceiveMessageSize(kLargestMessage);
  if (security.token.empty()) return grpc::CreateCustomChannel(server, *credentials, arguments);
  std::vector<std::unique_ptr<interception::ClientInterceptorFactoryInterface>> interceptors;
  interceptors.push_back(std::make_unique<TokenInterceptorFactory>(security.token));
  return interception::CreateCustomChannelWithInterceptors(server, *credentials, arguments,
                                                           std::move(interceptors));
}

}  // namespace spikeserve
