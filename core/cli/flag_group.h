// Declares the flags of a command.
//
// Not thread-safe. Declare all flags before Program::Run.
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "core/cli/flag_value.h"

namespace CLI {
class App;
}

namespace spikeserve {

// The flags under one heading of a command's help. A flag stores its value in a variable. The
// initial value of the variable is the flag's default, and the variable must live until
// Program::Run returns.
//
//   program.root().Flags("Serving")
//       .Add("listen", "HOST:PORT", &options.listen, "Address of the gRPC service")
//       .Add("drain_timeout", "DURATION", &options.drain_timeout, "Time for calls to finish");
//
// `kind` describes the value in the help. For the kinds FILE and DIR the shell completes files and
// directories; for a kind such as unary|stream|batch it completes these words.
class FlagGroup {
 public:
  FlagGroup(CLI::App* app, std::string heading);

  // Adds --name=VALUE. T is one of the types of flag_value.h. A value that cannot be parsed as T is
  // an error with the flag, the expected and the received value. If a flag is given twice, the last
  // value is used.
  template <typename T>
  FlagGroup& Add(const std::string& name, const std::string& kind, T* value,
                 const std::string& help) {
    return AddParsed(
        name, kind, FlagValueText(*value),
        [value](const std::string& text) { return ParseFlagValue(text, value); }, help);
  }

  // As Add, for a value that may also be given without --name=.
  FlagGroup& AddArgument(const std::string& name, const std::string& kind, std::string* value,
                         const std::string& help);

  // Adds --name=VALUE,VALUE,... If the flag is given twice, the values of both are used.
  FlagGroup& AddList(const std::string& name, const std::string& kind,
                     std::vector<std::string>* values, const std::string& help);

  // Adds --name, which sets `value` to true; --name=false sets it to false. REQUIRES: `*value` is
  // false.
  FlagGroup& AddSwitch(const std::string& name, bool* value, const std::string& help);

  // Adds --name=VALUE for any other type. `parse` parses and stores the value; its errors read
  // "expected X, received Y". The help shows `default_text` as the default.
  FlagGroup& AddParsed(const std::string& name, const std::string& kind,
                       const std::string& default_text,
                       std::function<absl::Status(const std::string&)> parse,
                       const std::string& help);

 private:
  CLI::App* app_;
  std::string heading_;
};

}  // namespace spikeserve
