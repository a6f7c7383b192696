// The actions of operators about shared heads, roll-outs, the files of versions and usage. Each one
// calls one server, and returns what is to be printed, or the error of the call.
#pragma once

#include "absl/status/status.h"
#include "client/spikectl/admin_call.h"

namespace spikeserve {

absl::StatusOr<Answer> ShowHead(const AdminFlags& flags);
absl::StatusOr<Answer> PromoteHead(const AdminFlags& flags);
absl::StatusOr<Answer> RollbackHead(const AdminFlags& flags);
// Takes an operator's corrections out of the head of --policy, or of --session on any server.
absl::StatusOr<Answer> UndoCorrections(const AdminFlags& flags);
absl::StatusOr<Answer> PauseLearning(const AdminFlags& flags);
absl::StatusOr<Answer> ResumeLearning(const AdminFlags& flags);

// Starts a roll-out, or ends the running one if --abort is set.
absl::StatusOr<Answer> ChangeRollout(const AdminFlags& flags);

// Shows the last roll-out of every policy.
absl::StatusOr<Answer> ShowRollouts(const AdminFlags& flags);

// Shows who changed what.
absl::StatusOr<Answer> ShowHistory(const AdminFlags& flags);

// Sends --file as a version, and starts its roll-out if --rollout is set.
absl::StatusOr<Answer> PushVersion(const AdminFlags& flags);
// Writes the file of a version, and its signature if it has one.
absl::StatusOr<Answer> PullVersion(const AdminFlags& flags);
// Removes a version that was pushed.
absl::StatusOr<Answer> RemoveVersion(const AdminFlags& flags);

// Shows what was used in a month.
absl::StatusOr<Answer> ShowUsage(const AdminFlags& flags);

}  // namespace spikeserve
