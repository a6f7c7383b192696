#include "client/tools/security_flags.h"

#include <cstdlib>
#include <string>
#include <utility>

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"

namespace spikeserve {

void AddSecurityFlags(Command program, SecurityFlags* flags) {
  program.Flags("Security")
      .AddSwitch("tls", &flags->options.tls, "Use TLS; --tls_ca and --tls_certificate imply it")
      .Add("tls_ca", "FILE", &flags->options.ca,
           "PEM authorities of the server; default: the system's")
      .Add("tls_certificate", "FILE", &flags->options.certificate, "PEM certificate of this client")
      .Add("tls_key", "FILE", &flags->options.key, "PEM private key of the certificate")
      .Add("token_file", "FILE", &flags->token_file,
           "File of the bearer token; default: $SPIKESERVE_TOKEN");
}

absl::StatusOr<SecurityOptions> ReadSecurityOptions(const SecurityFlags& flags) {
  SecurityOptions security = flags.options;
  if (!flags.token_file.empty()) {
    auto token = ReadTokenFile(flags.token_file);
    if (!token.ok()) {
      return absl::Status(token.status().code(),
                          absl::StrCat("--token_file: ", token.status().message()));
    }
    security.token = *std::move(token);
  } else if (const char* token = std::getenv("SPIKESERVE_TOKEN"); token != nullptr) {
    security.token = std::string(absl::StripAsciiWhitespace(token));  // as that of a file
  }
  return security;
}

}  // namespace spikeserve
