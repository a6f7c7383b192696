#include <unistd.h>

#include <algorithm>
#include <set>

#include "absl/strings/ascii.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/status.h"
#include "core/cli/program_parts.h"

namespace spikeserve {
namespace {

// What the tests and benchmarks of this repository set beside flags.
constexpr absl::string_view kOfTests[] = {"PROGRAM",         "SERVER_FLAGS", "INTEROP",
                                          "VERSION",         "SHARE",        "BUILD_DIR",
                                          "LISTED_SESSIONS", "SCREENSHOTS",  "TORCH"};

void AddVariables(const CLI::App& app, std::set<std::string>* names) {
  for (const CLI::Option* option : app.get_options({})) names->insert(option->get_envname());
  for (const CLI::App* command : app.get_subcommands({})) AddVariables(*command, names);
}

// Returns whether `name`, without the name of the program, is one that Kubernetes sets for each
// service: SERVICE_HOST, SERVICE_PORT_HTTP, PORT, PORT_50051_TCP_ADDR.
bool IsOfKubernetes(absl::string_view name) {
  return name == "SERVICE_HOST" || name == "SERVICE_PORT" || name == "PORT" ||
         absl::StartsWith(name, "SERVICE_PORT_") ||
         (absl::StartsWith(name, "PORT_") && name.size() > 5 &&
          absl::ascii_isdigit(static_cast<unsigned char>(name[5])));
}

// Returns the known name that begins most like `name`.
std::string Nearest(const std::set<std::string>& known, const std::string& name) {
  const auto shared = [&](const std::string& other) {
    return std::mismatch(name.begin(), name.end(), other.begin(), other.end()).first - name.begin();
  };
  return *std::max_element(known.begin(), known.end(),
                           [&](const auto& a, const auto& b) { return shared(a) < shared(b); });
}

}  // namespace

absl::Status CheckVariables(const CLI::App& root, const std::vector<std::string>& others) {
  std::set<std::string> known;
  AddVariables(root, &known);
  const std::string prefix = absl::StrCat(absl::AsciiStrToUpper(root.get_name()), "_");
  // Program reads this one itself, before CLI11 reads the others.
  known.insert(prefix + "CONFIG");
  for (char** entry = environ; *entry != nullptr; ++entry) {
    const absl::string_view variable = *entry;
    if (!absl::StartsWith(variable, prefix)) continue;
    const std::string name(variable.substr(0, variable.find('=')));
    const absl::string_view rest = absl::string_view(name).substr(prefix.size());
    const bool is_other =
        std::find(others.begin(), others.end(), name) != others.end() || IsOfKubernetes(rest) ||
        std::find(std::begin(kOfTests), std::end(kOfTests), rest) != std::end(kOfTests);
    if (is_other || known.contains(name)) continue;
    return InvalidArgument(
        "environment", absl::StrCat("variables of flags, such as ", Nearest(known, name)), name);
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
