// Reads flags from a file.
#ifndef CORE_CLI_CONFIG_FILE_H_
#define CORE_CLI_CONFIG_FILE_H_

#include <CLI/CLI.hpp>
#include <istream>
#include <vector>

namespace spikeserve {

// Reads TOML or INI: `flag = value`, those of a subcommand in a section [command] or
// [command.subcommand]. Refuses keys that are no flags, and leaves out flags that the environment
// sets: CLI11 alone would let the file win over the environment.
class ConfigFile final : public CLI::ConfigBase {
 public:
  // `root` must outlive this.
  explicit ConfigFile(CLI::App* root) : root_(root) {}

  // Throws CLI::ConfigError, which says what was expected and what was received.
  std::vector<CLI::ConfigItem> from_config(std::istream& input) const override;

 private:
  CLI::App* const root_;
};

}  // namespace spikeserve

#endif  // CORE_CLI_CONFIG_FILE_H_
