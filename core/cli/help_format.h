// Formats the text that --help prints.
#ifndef CORE_CLI_HELP_FORMAT_H_
#define CORE_CLI_HELP_FORMAT_H_

#include <CLI/CLI.hpp>
#include <string>

namespace spikeserve {

// CLI11's format with two changes: the default of a flag follows its help in brackets, and the help
// of a subcommand also lists the flags of the program, because the subcommand accepts them.
class HelpFormat final : public CLI::Formatter {
 public:
  HelpFormat();

  std::string make_help(const CLI::App* app, std::string name,
                        CLI::AppFormatMode mode) const override;
  std::string make_usage(const CLI::App* app, std::string name) const override;
  std::string make_option_opts(const CLI::Option* option) const override;
  std::string make_option_desc(const CLI::Option* option) const override;

 private:
  std::string MakeFlags(const CLI::App* app) const;
};

}  // namespace spikeserve

#endif  // CORE_CLI_HELP_FORMAT_H_
