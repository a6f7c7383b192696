#include "client/python/engine/policy_source.h"

#include <fcntl.h>
#include <unistd.h>

#include <functional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/model/policy_file.h"
#include "core/model/safetensors.h"

namespace spikeserve {

absl::StatusOr<std::unique_ptr<const PolicySource>> PolicySource::Open(const std::string& path) {
  const int descriptor = open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (descriptor < 0) {
    return absl::NotFoundError(absl::StrCat(path, ": expected a file that can be read"));
  }
  std::unique_ptr<PolicySource> source(new PolicySource(path, descriptor));
  ASSIGN_OR_RETURN(const std::string bytes, source->ReadBytes());
  source->hash_ = std::hash<std::string>()(bytes);
  return std::unique_ptr<const PolicySource>(std::move(source));
}

PolicySource::PolicySource(std::string path, int descriptor)
    : path_(std::move(path)), descriptor_(descriptor) {}

PolicySource::~PolicySource() { close(descriptor_); }

absl::StatusOr<Policy> PolicySource::Read() const {
  ASSIGN_OR_RETURN(const std::string bytes, ReadBytes());
  if (std::hash<std::string>()(bytes) != hash_) {
    return absl::FailedPreconditionError(absl::StrCat(
        path_, ": expected the content that the engine plays, received other content"));
  }
  absl::StatusOr<Policy> policy = ParsePolicyFile(bytes);
  if (!policy.ok()) return Annotate(policy.status(), path_);
  return policy;
}

absl::StatusOr<std::string> PolicySource::ReadBytes() const {
  // Opens the same file once more, whatever its name is now.
  absl::StatusOr<std::string> bytes =
      ReadSafetensorsFile(absl::StrCat("/proc/self/fd/", descriptor_));
  if (!bytes.ok()) return Annotate(bytes.status(), path_);
  return bytes;
}

}  // namespace spikeserve
