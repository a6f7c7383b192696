// How --help looks.
#ifndef CORE_CLI_HELP_FORMAT_H_
#define CORE_CLI_HELP_FORMAT_H_

#include <CLI/CLI.hpp>
#include <string>

namespace spikeserve {

// CLI11's format with the default of a flag in brackets behind its text, and with the flags of the
// program below those of a subcommand, which accepts them, too.
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
