// Declares the flags of a command.
//
// Not thread-safe; flags are declared before Program::Run.
#ifndef CORE_CLI_FLAG_GROUP_H_
#define CORE_CLI_FLAG_GROUP_H_

#include <functional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "core/cli/flag_value.h"

namespace CLI {
class App;
}

namespace spikeserve {

// The flags under one heading of a command's help. A variable that a flag writes to holds the
// default before, and must live until Program::Run returns.
//
//   program.root().Flags("Serving")
//       .Add("listen", "HOST:PORT", &options.listen, "Address of the gRPC service")
//       .Add("drain_timeout", "DURATION", &options.drain_timeout, "Time for calls to finish");
//
// `kind` stands for the value in the help. The shell completes file names for FILE, directories for
// DIR and the words of a kind such as unary|stream|batch.
class FlagGroup {
 public:
  FlagGroup(CLI::App* app, std::string heading);

  // Adds --name=VALUE. T is a type of flag_value.h. A text that is no T is an error that names the
  // flag, what was expected and what was received. A flag that is given twice has its last value.
  template <typename T>
  FlagGroup& Add(const std::string& name, const std::string& kind, T* value,
                 const std::string& help) {
    return AddParsed(
        name, kind, FlagValueText(*value),
        [value](const std::string& text) { return ParseFlagValue(text, value); }, help);
  }

  // Adds --name=VALUE,VALUE,... A flag that is given twice has the values of both.
  FlagGroup& AddList(const std::string& name, const std::string& kind,
                     std::vector<std::string>* values, const std::string& help);

  // Adds --name, which sets `value`, whose default is false; --name=false clears it.
  FlagGroup& AddSwitch(const std::string& name, bool* value, const std::string& help);

  // Adds --name=VALUE for a type of the caller's. `parse` stores the value; the message of its
  // error reads "expected X, received Y". `default_text` is what the help shows.
  FlagGroup& AddParsed(const std::string& name, const std::string& kind,
                       const std::string& default_text,
                       std::function<absl::Status(const std::string&)> parse,
                       const std::string& help);

 private:
  CLI::App* app_;
  std::string heading_;
};

}  // namespace spikeserve

#endif  // CORE_CLI_FLAG_GROUP_H_
