// The actions of operators about shared heads, roll-outs, the files of versions and usage. Each one
// calls one server, and returns what is to be printed, or the error of the call.
#pragma once

#include "absl/status/status.h"
#include "client/spikectl/admin_call.h"

namespace spikeserve {

absl::StatusOr<ServerAnswer> ShowHead(const AdminFlags& flags);
absl::StatusOr<ServerAnswer> PromoteHead(const AdminFlags& flags);
absl::StatusOr<ServerAnswer> RollbackHead(const AdminFlags& flags);
// Takes an operator's corrections out of the head of --policy, or of --session on any server.
absl::StatusOr<ServerAnswer> UndoCorrections(const AdminFlags& flags);
absl::StatusOr<ServerAnswer> PauseLearning(const AdminFlags& flags);
absl::StatusOr<ServerAnswer> ResumeLearning(const AdminFlags& flags);

// Starts a roll-out, or ends the running one if --abort is set.
absl::StatusOr<ServerAnswer> ChangeRollout(const AdminFlags& flags);

// Shows the last roll-out of every policy.
absl::StatusOr<ServerAnswer> ShowRollouts(const AdminFlags& flags);

// Shows who changed what.
absl::StatusOr<ServerAnswer> ShowHistory(const AdminFlags& flags);

// Sends --file as a version, and starts its roll-out if --rollout is set.
absl::StatusOr<ServerAnswer> PushVersion(const AdminFlags& flags);
// Writes the file of a version, and its signature if it has one.
absl::StatusOr<ServerAnswer> PullVersion(const AdminFlags& flags);
// Removes a version that was pushed.
absl::StatusOr<ServerAnswer> RemoveVersion(const AdminFlags& flags);

// Shows what was used in a month.
absl::StatusOr<ServerAnswer> ShowUsage(const AdminFlags& flags);

}  // namespace spikeserve
