#include "server/heads/head_log_metrics.h"

namespace spikeserve {
namespace {

prometheus::Counter& AddCounter(prometheus::Registry* registry, const char* name, const char* help,
                                const char* outcome) {
  return prometheus::BuildCounter().Name(name).Help(help).Register(*registry).Add(
      {{"outcome", outcome}});
}

constexpr char kEntries[] = "spikeserve_head_log_entries_total";
constexpr char kEntriesHelp[] =
    "Entries of the logs of shared heads that this server has appended, found there already "
    "(known), or taken into its heads (folded).";
constexpr char kReloads[] = "spikeserve_head_log_reloads_total";
constexpr char kReloadsHelp[] =
    "Times that a log did not go on from the heads of this server, which then took the stored "
    "heads (reloaded), stored its own (rewritten), or gave up the entries after a gap (cut).";

}  // namespace

HeadLogMetrics::HeadLogMetrics(prometheus::Registry* registry)
    : appended(AddCounter(registry, kEntries, kEntriesHelp, "appended")),
      known(AddCounter(registry, kEntries, kEntriesHelp, "known")),
      folded(AddCounter(registry, kEntries, kEntriesHelp, "folded")),
      reloaded(AddCounter(registry, kReloads, kReloadsHelp, "reloaded")),
      rewritten(AddCounter(registry, kReloads, kReloadsHelp, "rewritten")),
      cut(AddCounter(registry, kReloads, kReloadsHelp, "cut")),
      positions(prometheus::BuildGauge()
                    .Name("spikeserve_head_log_position")
                    .Help("Number of the last entry of the log of a shared head that this server "
                          "has taken.")
                    .Register(*registry)) {}

}  // namespace spikeserve
