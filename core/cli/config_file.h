// Reads flags from a configuration file.
#ifndef CORE_CLI_CONFIG_FILE_H_
#define CORE_CLI_CONFIG_FILE_H_

#include <CLI/CLI.hpp>
#include <istream>
#include <vector>

namespace spikeserve {

// Reads TOML or INI files with lines `flag = value`. The flags of a subcommand are in a section
// [command] or [command.subcommand]. A key that is not a flag is an error. Skips flags that are
// also set by the environment, because in CLI11 the file has priority over the environment.
class ConfigFile final : public CLI::ConfigBase {
 public:
  // `root` must outlive this.
  explicit ConfigFile(CLI::App* root) : root_(root) {}

  // Throws CLI::ConfigError with a message that contains the expected and the received value.
  std::vector<CLI::ConfigItem> from_config(std::istream& input) const override;

 private:
  CLI::App* const root_;
};

}  // namespace spikeserve

#endif  // CORE_CLI_CONFIG_FILE_H_
