// Reads one policy file several times, also after another file has taken its name.
//
//   auto source = PolicySource::Open("policy.safetensors");
//   absl::StatusOr<Policy> policy = (*source)->Read();
//
// Thread-safe. Holds a file descriptor.
#pragma once

#include <cstddef>
#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "core/model/policy.h"

namespace spikeserve {

class PolicySource {
 public:
  // NOT_FOUND if there is no such file.
  static absl::StatusOr<std::unique_ptr<const PolicySource>> Open(const std::string& path);

  ~PolicySource();
  PolicySource(const PolicySource&) = delete;
  PolicySource& operator=(const PolicySource&) = delete;

  // Errors: see ReadPolicyFile. FAILED_PRECONDITION if the content has changed since Open.
  absl::StatusOr<Policy> Read() const;

 private:
  PolicySource(std::string path, int descriptor);

  absl::StatusOr<std::string> ReadBytes() const;

  const std::string path_;
  const int descriptor_;
  size_t hash_ = 0;  // of the content
};

}  // namespace spikeserve
