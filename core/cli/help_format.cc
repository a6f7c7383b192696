#include <algorithm>
#include <vector>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "core/cli/command_tree.h"
#include "core/cli/program_parts.h"

namespace spikeserve {
namespace {

constexpr size_t kColumnWidth = 32;  // the column at which the help of a flag begins

const CLI::App* RootOf(const CLI::App* app) {
  while (app->get_parent() != nullptr) app = app->get_parent();
  return app;
}

// Returns whether `app` has a flag of its own with the name of `option`.
bool Hides(const CLI::App* app, const CLI::Option* option) {
  const CLI::Option* const own = app->get_option_no_throw("--" + option->get_lnames().front());
  return own != nullptr && own != option && !own->get_group().empty();
}

std::vector<std::string> Headings(const CLI::App* app) {
  std::vector<std::string> headings = app->get_groups();
  headings.erase(std::remove(headings.begin(), headings.end(), ""), headings.end());
  std::stable_partition(headings.begin(), headings.end(),
                        [](const std::string& heading) { return heading != kGeneralHeading; });
  return headings;
}

}  // namespace

HelpFormat::HelpFormat() { column_width(kColumnWidth); }

std::string HelpFormat::make_help(const CLI::App* app, std::string name,
                                  CLI::AppFormatMode mode) const {
  return absl::StrCat(make_description(app), make_usage(app, name), make_subcommands(app, mode),
                      MakeFlags(app), "\n", make_footer(app));
}

std::string HelpFormat::make_usage(const CLI::App* app, std::string name) const {
  const char* const command = app->get_subcommands({}).empty() ? "" : " COMMAND";
  return absl::StrCat("Usage: ", name, command, " [--FLAG=VALUE ...]\n");
}

std::string HelpFormat::MakeFlags(const CLI::App* app) const {
  const CLI::App* const root = RootOf(app);
  std::string text;
  bool after_advanced = false;  // their lines stand together
  for (const CLI::App* owner : {app, root}) {
    for (const std::string& heading : Headings(owner)) {
      const auto shown = [&](const CLI::Option* option) {
        return option->get_group() == heading && (owner == app || !Hides(app, option));
      };
      const std::vector<const CLI::Option*> options = owner->get_options(shown);
      if (options.empty()) continue;
      if (absl::StartsWith(heading, kAdvancedPrefix)) {
        absl::StrAppend(&text, after_advanced ? "" : "\n", heading, ": ", options.size(),
                        " flags, which the manual describes (--generate=man)\n");
        after_advanced = true;
      } else {
        absl::StrAppend(&text, make_group(heading, false, options));
        after_advanced = false;
      }
    }
    if (owner == root) break;
  }
  return text;
}

std::string HelpFormat::make_option_opts(const CLI::Option* option) const {
  return option->get_expected_max() == 0 ? "" : " " + option->get_type_name();
}

std::string HelpFormat::make_option_desc(const CLI::Option* option) const {
  const std::string& text = option->get_default_str();
  return text.empty() ? option->get_description()
                      : absl::StrCat(option->get_description(), " [", text, "]");
}

}  // namespace spikeserve
