// Where replicas keep what they share of the settings of operators, and the files of versions that
// were promoted or pushed.
//
// Implementations are thread-safe. All methods block, and return UNAVAILABLE if the store cannot be
// reached.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

namespace spikeserve {

class SharedSettings {
 public:
  // All settings (policy_settings.h), and how often they were written.
  struct Document {
    int64_t revision = 0;  // 0: never
    std::string json;

    friend bool operator==(const Document&, const Document&) = default;
  };

  // A version, as <policy>@<version>, and the SHA-256 of its file.
  struct VersionFile {
    std::string version;
    std::string sha256;
  };
  struct ComparedFiles {
    std::vector<std::string> different;  // versions of which other servers have another file
    int64_t revision = 0;                // FilesRevision() afterwards
  };

  virtual ~SharedSettings() = default;

  virtual absl::StatusOr<Document> Read() = 0;
  // Replaces the settings of revision `replaced`. Returns ABORTED and changes nothing if the store
  // has another revision.
  virtual absl::Status Write(const Document& document, int64_t replaced) = 0;

  // Stores a file under a name that begins with the SHA-256 of a policy file in hexadecimal.
  virtual absl::Status PutFile(const std::string& name, const std::string& bytes) = 0;
  // Removes it, if the store has it.
  virtual absl::Status RemoveFile(const std::string& name) = 0;
  // Returns NOT_FOUND if the store does not have the file.
  virtual absl::StatusOr<std::string> GetFile(const std::string& name) = 0;

  // Says which files this server has, and compares them with those of the other servers that are
  // `alive`.
  virtual absl::StatusOr<ComparedFiles> CompareFiles(const std::vector<VersionFile>& files,
                                                     const std::vector<std::string>& alive) = 0;
  // Returns those of `servers` that have not said by CompareFiles() that they have this file.
  virtual absl::StatusOr<std::vector<std::string>> ServersWithout(
      const VersionFile& file, const std::vector<std::string>& servers) = 0;
  // Returns a number that changes when a server says that it has another file than before.
  virtual absl::StatusOr<int64_t> FilesRevision() = 0;
};

}  // namespace spikeserve
