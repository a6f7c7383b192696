// What servers share in Redis beside sessions: the settings of operators, the files of promoted and
// pushed versions, which servers are alive, and what each reports about itself.
//
// - cfg, a hash: revision and settings.
// - pf:<SHA-256>: the file of a promoted version; pf:<SHA-256>.sig: its signature.
// - pf:<SHA-256>.<policy>.<version>: a pushed version (server/policies/stored_versions.cc).
// - pf:versions, a hash: of each policy version, the server that had it first and the SHA-256 of
// its
//   file; and the number of changes.
// - pf:servers, a hash: of each server, its last report and when it was written.
// - r, a sorted set: the servers, by the time at which they were alive last.
//
// Thread-safe. All methods block for at most a few RedisOptions::timeout.
#pragma once

#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "core/store/redis_options.h"
#include "core/store/shared_redis.h"
#include "server/base/replica_reports.h"
#include "server/policies/shared_settings.h"

namespace spikeserve {

class RedisShared final : public SharedSettings {
 public:
  // `replica` identifies this server.
  RedisShared(RedisOptions options, std::string replica)
      : redis_(std::move(options)), replica_(std::move(replica)) {}

  const std::string& replica() const { return replica_; }

  absl::StatusOr<Document> Read() override;
  absl::Status Write(const Document& document, int64_t replaced) override;
  absl::Status PutFile(const std::string& name, const std::string& bytes) override;
  absl::Status RemoveFile(const std::string& name) override;
  absl::StatusOr<std::string> GetFile(const std::string& name) override;
  absl::StatusOr<ComparedFiles> CompareFiles(const std::vector<VersionFile>& files,
                                             const std::vector<std::string>& alive) override;
  absl::StatusOr<std::vector<std::string>> ServersWithout(
      const VersionFile& file, const std::vector<std::string>& servers) override;
  absl::StatusOr<int64_t> FilesRevision() override;

  // Says that this server is alive, and returns all that are.
  absl::StatusOr<std::vector<std::string>> Heartbeat();
  // Writes the report of this server, and returns those of all that are at most ten minutes old.
  // `now` is the time of the clock of ReplicaReport::written.
  absl::StatusOr<std::vector<ReplicaReport>> Report(const std::string& json, absl::Duration now);
  // Says that this server ends.
  absl::Status Leave();

 private:
  SharedRedis redis_;
  const std::string replica_;
};

}  // namespace spikeserve
