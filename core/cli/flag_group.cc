#include "core/cli/flag_group.h"

#include <CLI/CLI.hpp>
#include <utility>

#include "absl/strings/str_join.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

// Returns a callback that parses the last of the values that were given. CLI11 calls it while it
// parses the command line, and Program::Parse catches the exceptions that it throws.
CLI::callback_t LastValue(const std::string& name,
                          std::function<absl::Status(const std::string&)> parse) {
  return [name, parse = std::move(parse)](const CLI::results_t& results) {
    const absl::Status status = parse(results.back());
    if (status.ok()) return true;
    throw CLI::ValidationError("--" + name, std::string(status.message()));
  };
}

}  // namespace

FlagGroup::FlagGroup(CLI::App* app, std::string heading)
    : app_(app), heading_(std::move(heading)) {}

FlagGroup& FlagGroup::AddArgument(const std::string& name, const std::string& kind,
                                  std::string* value, const std::string& help) {
  const auto parse = [value](const std::string& text) { return ParseFlagValue(text, value); };
  app_->add_option("--" + name + "," + name, LastValue(name, parse), help)
      ->type_name(kind)
      ->group(heading_)
      ->default_str(*value)
      ->take_last();
  return *this;
}

FlagGroup& FlagGroup::AddList(const std::string& name, const std::string& kind,
                              std::vector<std::string>* values, const std::string& help) {
  const auto store = [values](const CLI::results_t& results) {
    *values = results == CLI::results_t{""} ? CLI::results_t() : results;
    return true;
  };
  app_->add_option("--" + name, store, help)
      ->type_name(kind)
      ->group(heading_)
      ->default_str(absl::StrJoin(*values, ","))
      ->delimiter(',')
      ->multi_option_policy(CLI::MultiOptionPolicy::TakeAll);
  return *this;
}

FlagGroup& FlagGroup::AddSwitch(const std::string& name, bool* value, const std::string& help) {
  SPIKESERVE_DCHECK(!*value);
  const auto parse = [value](const std::string& text) { return ParseFlagValue(text, value); };
  app_->add_option("--" + name, LastValue(name, parse), help)
      ->group(heading_)
      ->expected(0)
      ->take_last();
  return *this;
}

FlagGroup& FlagGroup::AddParsed(const std::string& name, const std::string& kind,
                                const std::string& default_text,
                                std::function<absl::Status(const std::string&)> parse,
                                const std::string& help) {
  app_->add_option("--" + name, LastValue(name, std::move(parse)), help)
      ->type_name(kind)
      ->group(heading_)
      ->default_str(default_text)
      ->take_last();
  return *this;
}

}  // namespace spikeserve
