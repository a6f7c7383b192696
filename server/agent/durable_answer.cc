#include "server/agent/durable_answer.h"

#include <atomic>
#include <utility>

namespace spikeserve {
namespace {

// Gathers the outcomes.
struct Gathering {
  std::atomic<size_t> missing;
  std::vector<absl::Status> outcomes;
  std::function<void(const std::vector<absl::Status>&)> done;
};

}  // namespace

void AddCommit(const SessionEntry& entry, Commits* commits) {
  if (entry.journal == nullptr || !entry.journal->is_sync()) return;
  commits->push_back({entry.journal, entry.journal->written()});
}

void AddConfirmation(const SessionEntry& entry, bool has_decided, Commits* commits) {
  if (entry.journal == nullptr) return;
  if (!entry.journal->is_shared()) return AddCommit(entry, commits);
  if (!has_decided) entry.journal->OnConfirm();
  commits->push_back({entry.journal, entry.journal->written()});
}

void WhenDurable(const Commits& commits,
                 std::function<void(const std::vector<absl::Status>& outcomes)> done) {
  const auto gathering = std::make_shared<Gathering>();
  gathering->missing = commits.size();
  gathering->outcomes.resize(commits.size());
  gathering->done = std::move(done);
  for (size_t i = 0; i < commits.size(); ++i) {
    const auto finish = [gathering, i](const absl::Status& status) {
      gathering->outcomes[i] = status;
      if (gathering->missing.fetch_sub(1) == 1) gathering->done(gathering->outcomes);
    };
    commits[i].journal->WhenDurable(
        commits[i].position,
        [finish, contribution = commits[i].contribution](const absl::Status& status) {
          if (!status.ok() || contribution == nullptr) return finish(status);
          contribution->WhenMerged(finish);
        });
  }
}

}  // namespace spikeserve
