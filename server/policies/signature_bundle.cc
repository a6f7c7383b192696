#include "server/policies/signature_bundle.h"

#include "absl/status/status.h"
#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/base/status_macros.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

constexpr char kPayloadType[] = "application/vnd.in-toto+json";
constexpr char kPredicateType[] = "https://model_signing/signature/v1.0";

// Returns the text at `path`, a JSON pointer, or an empty one if there is none.
std::string MemberText(const Json& value, const char* path) {
  const Json::json_pointer pointer(path);
  if (!value.contains(pointer) || !value.at(pointer).is_string()) return "";
  return value.at(pointer).get<std::string>();
}

absl::StatusOr<std::string> Base64At(const Json& value, const char* path) {
  std::string bytes;
  const std::string text = MemberText(value, path);
  if (!text.empty() && absl::Base64Unescape(text, &bytes)) return bytes;
  return absl::InvalidArgumentError(absl::StrCat("bundle", path, ": expected base64"));
}

absl::Status CheckText(const Json& value, const char* path, absl::string_view expected) {
  const std::string received = MemberText(value, path);
  if (received == expected) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("bundle", path, ": expected ", expected, ", received ", Quoted(received)));
}

}  // namespace

absl::StatusOr<SignatureBundle> ParseBundle(absl::string_view bytes) {
  ASSIGN_OR_RETURN(const Json value, ParseJsonObject("bundle", bytes));
  RETURN_IF_ERROR(CheckText(value, "/dsseEnvelope/payloadType", kPayloadType));
  if (value.contains(Json::json_pointer("/dsseEnvelope/signatures/1"))) {
    return absl::InvalidArgumentError(
        "bundle/dsseEnvelope/signatures: expected one, received more");
  }
  SignatureBundle bundle;
  ASSIGN_OR_RETURN(bundle.statement, Base64At(value, "/dsseEnvelope/payload"));
  ASSIGN_OR_RETURN(bundle.signature, Base64At(value, "/dsseEnvelope/signatures/0/sig"));
  bundle.signed_text = absl::StrCat("DSSEv1 ", sizeof(kPayloadType) - 1, " ", kPayloadType, " ",
                                    bundle.statement.size(), " ", bundle.statement);
  return bundle;
}

absl::StatusOr<std::map<std::string, std::string>> FilesOf(const SignatureBundle& bundle) {
  ASSIGN_OR_RETURN(const Json statement, ParseJsonObject("bundle", bundle.statement));
  RETURN_IF_ERROR(CheckText(statement, "/predicateType", kPredicateType));
  RETURN_IF_ERROR(CheckText(statement, "/predicate/serialization/method", "files"));
  const Json resources = statement["predicate"].value("resources", Json::array());
  std::map<std::string, std::string> files;
  for (const Json& resource : resources) {
    RETURN_IF_ERROR(CheckText(resource, "/algorithm", "sha256"));
    files[MemberText(resource, "/name")] = MemberText(resource, "/digest");
  }
  return files;
}

}  // namespace spikeserve
