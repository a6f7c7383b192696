#include "server/access/admission.h"

#include <string>

#include "absl/strings/str_cat.h"

namespace spikeserve {

absl::StatusOr<const Credential*> Admit(const Authenticator& authenticator,
                                        const grpc::CallbackServerContext& context, Method method) {
  const auto& metadata = context.client_metadata();
  const auto header = metadata.find("authorization");
  std::string_view token;
  std::string buffer;
  if (header != metadata.end()) {
    token = TokenOf({header->second.data(), header->second.size()}, &buffer);
  }
  auto caller = authenticator.Authenticate({token.data(), token.size()});
  if (!caller.ok()) return caller;
  if (auto status = CheckMayCall((*caller)->role(), method); !status.ok()) return status;
  return caller;
}

absl::StatusOr<const Credential*> AdmitToPages(const Authenticator& authenticator,
                                               absl::string_view header) {
  std::string buffer;
  const std::string_view token = TokenOf(header, &buffer);
  const auto caller = authenticator.Authenticate({token.data(), token.size()});
  if (!caller.ok()) return caller;
  if (auto status = CheckMayWatch((*caller)->role()); !status.ok()) return status;
  return caller;
}

absl::Status CheckStillAdmitted(const Credential& caller,
                                const google::protobuf::MessageLite& request,
                                int64_t max_message_bytes) {
  if (auto status = caller.CheckValid(); !status.ok()) return status;
  return CheckSize(caller, request, max_message_bytes);
}

absl::Status CheckSize(const Credential& caller, const google::protobuf::MessageLite& request,
                       int64_t max_message_bytes) {
  const auto bytes = static_cast<int64_t>(request.ByteSizeLong());
  if (bytes > max_message_bytes) {
    return absl::ResourceExhaustedError(absl::StrCat("--max_message_bytes: expected at most ",
                                                     max_message_bytes, ", received ", bytes));
  }
  return caller.tenant()->CheckMessage(bytes);
}

}  // namespace spikeserve
