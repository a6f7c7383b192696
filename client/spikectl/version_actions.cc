#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <iterator>
#include <string>
#include <system_error>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "client/spikectl/admin_actions.h"
#include "client/spikectl/traffic_report.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/digest/sha256.h"
#include "core/model/safetensors.h"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

constexpr int64_t kPulledBytes = int64_t{1} << 20;  // of PullPolicyResponse.data
constexpr auto kMostFileBytes = static_cast<int64_t>(kMaxSafetensorsFileBytes);

absl::Status CheckFile(const AdminFlags& flags) {
  if (!flags.file.empty()) return absl::OkStatus();
  return InvalidArgument("--file", "a policy file", "none");
}

std::string SignatureFile(const AdminFlags& flags) {
  return flags.signature.empty() ? absl::StrCat(flags.file, ".sig") : flags.signature;
}

// Returns the signature of the file; empty if there is none and none is named.
absl::StatusOr<std::string> ReadSignature(const AdminFlags& flags) {
  auto signature = ReadFile(SignatureFile(flags));
  if (absl::IsNotFound(signature.status()) && flags.signature.empty()) return "";
  return signature;
}

// Refuses an answer after which a server could send parts for ever.
absl::Status CheckPart(const v1::PullPolicyResponse& part, int64_t offset) {
  if (part.size() < offset || part.size() > kMostFileBytes) {
    return absl::DataLossError(absl::StrCat("size: expected ", offset, " to ", kMostFileBytes,
                                            " bytes, received ", part.size()));
  }
  const int64_t expected = std::min(part.size() - offset, kPulledBytes);
  if (std::ssize(part.data()) == expected) return absl::OkStatus();
  return absl::DataLossError(
      absl::StrCat("data: expected ", expected, " bytes, received ", part.data().size()));
}

}  // namespace

absl::StatusOr<ServerAnswer> PushVersion(const AdminFlags& flags) {
  RETURN_IF_ERROR(CheckFile(flags));
  auto request = HeadRequest<v1::PushPolicyRequest>(flags);
  request.set_make_default(flags.make_default);
  ASSIGN_OR_RETURN(const std::string file, ReadFile(flags.file));
  ASSIGN_OR_RETURN(*request.mutable_signature(), ReadSignature(flags));
  request.set_sha256(Sha256Of(file));
  ASSIGN_OR_RETURN(const auto admin, ConnectAdmin(*flags.server));
  ASSIGN_OR_RETURN(const auto pushed, admin->Push(std::move(request), file));
  ordered_json json = {{"policy", flags.policy},
                       {"version", pushed.version()},
                       {"existed", pushed.existed()},
                       {"removed", pushed.removed()}};
  std::string text = absl::StrCat("pushed ", flags.policy, "/", pushed.version(),
                                  pushed.existed() ? ", which was there" : "");
  if (!pushed.removed().empty()) {
    absl::StrAppend(&text, "; removed ", absl::StrJoin(pushed.removed(), ", "));
  }
  ServerAnswer answer = TrafficAnswer(std::move(text), std::move(json), pushed.traffic());
  if (flags.rollout.empty()) return answer;
  AdminFlags rollout = flags;
  rollout.version = pushed.version();
  rollout.steps = flags.rollout;
  auto started = ChangeRollout(rollout);
  if (!started.ok()) {
    return absl::Status(started.status().code(),
                        absl::StrCat("pushed version ", pushed.version(),
                                     ", without a roll-out: ", started.status().message()));
  }
  answer.json["rollout"] = started->json;
  absl::StrAppend(&answer.text, "\n", started->text);
  return answer;
}

absl::StatusOr<ServerAnswer> PullVersion(const AdminFlags& flags) {
  RETURN_IF_ERROR(CheckFile(flags));
  auto request = VersionRequest<v1::PullPolicyRequest>(flags);
  ASSIGN_OR_RETURN(const auto admin, ConnectAdmin(*flags.server));
  std::string file;
  v1::PullPolicyResponse part;
  do {
    ASSIGN_OR_RETURN(part, admin->Call(&AdminStub::PullPolicy, request));
    RETURN_IF_ERROR(CheckPart(part, request.offset()));
    file += part.data();
    request.set_version(part.version());
    request.set_offset(request.offset() + static_cast<int64_t>(part.data().size()));
  } while (request.offset() < part.size());
  if (const std::string sha256 = Sha256Of(file); sha256 != part.sha256()) {
    return absl::DataLossError(absl::StrCat("sha256: expected ", part.sha256(), ", received ",
                                            sha256, "; the file may just have been replaced"));
  }
  // A signature of the file before is none of this one.
  std::error_code ignored;
  std::filesystem::remove(SignatureFile(flags), ignored);
  RETURN_IF_ERROR(WriteFileAtomically(flags.file, {file}));
  if (!part.signature().empty()) {
    RETURN_IF_ERROR(WriteFileAtomically(SignatureFile(flags), {part.signature()}));
  }
  return ServerAnswer{
      absl::StrCat(flags.policy, "/", part.version(), ": ", file.size(), " bytes to ", flags.file,
                   part.signature().empty() ? "" : ", with the signature"),
      {{"policy", flags.policy},
       {"version", part.version()},
       {"file", flags.file},
       {"sha256", part.sha256()},
       {"signed", !part.signature().empty()}},
      /*shared=*/true};
}

absl::StatusOr<ServerAnswer> RemoveVersion(const AdminFlags& flags) {
  ASSIGN_OR_RETURN(const auto removed, CallAdmin(flags, &AdminStub::RemovePolicy,
                                                 VersionRequest<v1::RemovePolicyRequest>(flags)));
  return TrafficAnswer(absl::StrCat("removed ", flags.policy, "/", flags.version),
                       {{"policy", flags.policy}, {"version", flags.version}}, removed.traffic());
}

}  // namespace spikeserve
