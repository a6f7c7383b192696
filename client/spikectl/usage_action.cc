#include <cstdint>
#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_replace.h"
#include "absl/time/time.h"
#include "client/spikectl/admin_actions.h"
#include "core/base/status_macros.h"
#include "proto/json.h"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

std::string TimeText(int64_t seconds, const char* format) {
  return absl::FormatTime(format, absl::FromUnixSeconds(seconds), absl::UTCTimeZone());
}

// Returns what a row is told apart by, in the order of the request.
ordered_json KeysOf(const v1::UsageRow& row, const std::vector<std::string>& by) {
  ordered_json keys = ordered_json::object();
  for (const std::string& key : by) {
    if (key == "tenant") keys[key] = row.tenant();
    if (key == "policy") keys[key] = row.policy();
    if (key == "version") keys[key] = row.version();
    if (key == "label") keys[key] = row.label();
    if (key == "day") keys[key] = TimeText(row.start(), "%Y-%m-%d");
    if (key == "hour") keys[key] = TimeText(row.start(), "%Y-%m-%dT%H:00:00Z");
  }
  return keys;
}

// Adds the counts to the keys of a row; joules of every model, so that all rows have equal columns.
ordered_json RowOf(const v1::UsageRow& row, const std::vector<std::string>& by) {
  ordered_json json = KeysOf(row, by);
  const ordered_json counts = MessageToFields(row.usage(), Numbers::kExact);
  for (const auto& [name, value] : counts.items()) {
    if (name != "joules") {
      json[name] = value;
      continue;
    }
    for (const char* model : {"horowitz_45nm", "int_45nm", "int_sram_45nm"}) {
      json[absl::StrCat("joules_", model)] = value.value(model, 0.0);
    }
  }
  return json;
}

// Returns the value as RFC 4180 wants it.
std::string Csv(const ordered_json& value) {
  if (!value.is_string()) return value.dump();
  const auto text = value.get<std::string>();
  if (text.find_first_of(",\"\r\n") == std::string::npos) return text;
  return absl::StrCat("\"", absl::StrReplaceAll(text, {{"\"", "\"\""}}), "\"");
}

std::string CsvOf(const ordered_json& rows, const ordered_json& empty) {
  std::vector<std::string> names;
  for (const auto& [name, value] : empty.items()) names.push_back(name);
  std::string text = absl::StrJoin(names, ",");
  for (const ordered_json& row : rows) {
    std::vector<std::string> values;
    for (const auto& [name, value] : row.items()) values.push_back(Csv(value));
    absl::StrAppend(&text, "\n", absl::StrJoin(values, ","));
  }
  return text;
}

std::string TableOf(const ordered_json& rows, const std::vector<std::string>& by) {
  std::string text;
  for (const std::string& key : by) absl::StrAppendFormat(&text, "%-20s ", key);
  absl::StrAppend(&text, "   DECISIONS         SPIKES  INT_SRAM_J  HOROWITZ_J  SESSION_H  REFUSED");
  for (const ordered_json& row : rows) {
    text += "\n";
    for (const std::string& key : by) {
      const ordered_json& value = row.at(key);
      absl::StrAppendFormat(&text, "%-20s ",
                            value.is_string() ? value.get<std::string>() : value.dump());
    }
    absl::StrAppendFormat(
        &text, "%12d %14d %11.4g %11.4g %10.1f %8d", row["decisions"].get<int64_t>(),
        row["spikes"].get<int64_t>(), row["joules_int_sram_45nm"].get<double>(),
        row["joules_horowitz_45nm"].get<double>(), row["session_seconds"].get<double>() / 3600.0,
        row["refused_calls"].get<int64_t>());
  }
  return text;
}

}  // namespace

absl::StatusOr<ServerAnswer> ShowUsage(const AdminFlags& flags) {
  v1::GetUsageRequest request;
  request.set_month(flags.month);
  for (const std::string& key : flags.by) request.add_by(key);
  ASSIGN_OR_RETURN(const auto response, CallAdmin(flags, &AdminStub::GetUsage, request));
  ordered_json rows = ordered_json::array();
  for (const v1::UsageRow& row : response.rows()) rows.push_back(RowOf(row, flags.by));
  ordered_json budgets = ordered_json::array();
  std::string text = flags.csv
                         ? CsvOf(rows, RowOf(v1::UsageRow(), flags.by))
                         : absl::StrCat(response.month(), " (UTC)\n", TableOf(rows, flags.by));
  for (const v1::TenantBudget& budget : response.budgets()) {
    budgets.push_back({{"tenant", budget.tenant()},
                       {"budget", budget.name()},
                       {"limit", budget.limit()},
                       {"spent", budget.spent()}});
    if (flags.csv) continue;
    absl::StrAppendFormat(&text, "\nbudget of %s: %s %.4g of %.4g, begins again at %s",
                          budget.tenant(), budget.name(), budget.spent(), budget.limit(),
                          TimeText(response.resets_at(), "%Y-%m-%dT%H:%M:%SZ"));
  }
  return ServerAnswer{text,
                      {{"month", response.month()},
                       {"label_key", response.label_key()},
                       {"rows", rows},
                       {"budgets", budgets},
                       {"resets_at", response.resets_at()}},
                      response.shared()};
}

}  // namespace spikeserve
