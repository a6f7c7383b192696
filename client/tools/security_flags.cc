#include "client/tools/security_flags.h"

#include <cstdlib>
#include <string>
#include <utility>

#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"

ABSL_FLAG(bool, tls, false, "Encrypt; implied by --tls_ca and --tls_certificate");
ABSL_FLAG(std::string, tls_ca, "",
          "PEM file that signs the server's certificate; empty for what the system trusts");
ABSL_FLAG(std::string, tls_certificate, "", "PEM file of this client's certificate, if asked for");
ABSL_FLAG(std::string, tls_key, "", "PEM file of its key");
ABSL_FLAG(std::string, token_file, "",
          "File that holds the bearer token; empty for the environment variable SPIKESERVE_TOKEN");

namespace spikeserve {

absl::StatusOr<SecurityOptions> SecurityFromFlags() {
  SecurityOptions security;
  security.tls = absl::GetFlag(FLAGS_tls);
  security.ca = absl::GetFlag(FLAGS_tls_ca);
  security.certificate = absl::GetFlag(FLAGS_tls_certificate);
  security.key = absl::GetFlag(FLAGS_tls_key);
  if (const std::string path = absl::GetFlag(FLAGS_token_file); !path.empty()) {
    auto token = ReadTokenFile(path);
    if (!token.ok()) {
      return absl::Status(token.status().code(),
                          absl::StrCat("--token_file: ", token.status().message()));
    }
    security.token = *std::move(token);
  } else if (const char* token = std::getenv("SPIKESERVE_TOKEN"); token != nullptr) {
    security.token = token;
  }
  return security;
}

}  // namespace spikeserve
