// Where replicas keep what they share of the settings of operators, and the files of promoted
// versions.
//
// Implementations are thread-safe. All methods block, and return UNAVAILABLE if the store cannot be
// reached.
#ifndef SERVER_POLICIES_SHARED_SETTINGS_H_
#define SERVER_POLICIES_SHARED_SETTINGS_H_

#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

namespace spikeserve {

class SharedSettings {
 public:
  // All settings (policy_settings.h), and how often they were written.
  struct Document {
    int64_t revision = 0;  // 0: never
    std::string json;
  };

  virtual ~SharedSettings() = default;

  virtual absl::StatusOr<Document> Read() = 0;
  // Replaces the settings of revision `document.revision - 1`. Returns ABORTED and changes nothing
  // if the store has another revision.
  virtual absl::Status Write(const Document& document) = 0;

  // Stores a file under a name: the SHA-256 of a policy file in hexadecimal, and the same with
  // ".sig" for its signature.
  virtual absl::Status PutFile(const std::string& name, const std::string& bytes) = 0;
  // Returns NOT_FOUND if the store does not have the file.
  virtual absl::StatusOr<std::string> GetFile(const std::string& name) = 0;
};

}  // namespace spikeserve

#endif  // SERVER_POLICIES_SHARED_SETTINGS_H_
