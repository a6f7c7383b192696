#include "server/services/request_parser.h"

#include <google/protobuf/descriptor.h>
#include <google/protobuf/io/coded_stream.h>
#include <google/protobuf/wire_format_lite.h>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {
namespace {

using google::protobuf::Descriptor;
using google::protobuf::FieldDescriptor;
using google::protobuf::internal::WireFormatLite;

// Requests for a decision of at most this many bytes are not checked for empty beats.
constexpr size_t kShortAct = 4096;

// The shortest element: a tag and a length of zero.
constexpr int64_t kShortestElement = 2;

// Returns true for a list of messages, other than a map.
bool IsItem(const FieldDescriptor& field) {
  return field.is_repeated() && field.message_type() != nullptr && !field.is_map();
}

bool HasItems(const Descriptor& type) {
  for (int i = 0; i < type.field_count(); ++i) {
    if (IsItem(*type.field(i))) return true;
  }
  return false;
}

// Checks the elements of one request before they are stored.
class ElementChecker {
 public:
  explicit ElementChecker(absl::string_view bytes)
      : input_(reinterpret_cast<const uint8_t*>(bytes.data()), static_cast<int>(bytes.size())) {}

  // Checks a message of `type`, with those in it. Stops at the first byte that cannot be read,
  // where the parser stops, too.
  absl::Status Check(const Descriptor* type) {
    int groups = 0;  // that are open; what is in them is unknown
    while (const uint32_t tag = input_.ReadTag()) {
      const FieldDescriptor* field =
          groups > 0 ? nullptr : type->FindFieldByNumber(WireFormatLite::GetTagFieldNumber(tag));
      const auto form = WireFormatLite::GetTagWireType(tag);
      const bool has_length = form == WireFormatLite::WIRETYPE_LENGTH_DELIMITED;
      if ((field == nullptr || has_length) && ++elements_ > kMaxElements) return TooMany();
      if (form == WireFormatLite::WIRETYPE_START_GROUP) {
        ++groups;
      } else if (form == WireFormatLite::WIRETYPE_END_GROUP) {
        --groups;
      } else if (has_length && field != nullptr && field->message_type() != nullptr) {
        RETURN_IF_ERROR(CheckNested(*field));
      } else if (!WireFormatLite::SkipField(&input_, tag)) {
        return absl::OkStatus();
      }
    }
    return absl::OkStatus();
  }

 private:
  absl::Status CheckNested(const FieldDescriptor& field) {
    uint32_t length = 0;
    if (!input_.ReadVarint32(&length)) return absl::OkStatus();
    if (length == 0 && IsItem(field)) {
      return InvalidArgument(field.name(), "items that are not empty", "an empty one");
    }
    const auto limit = input_.PushLimit(static_cast<int>(length));
    auto status = Check(field.message_type());
    input_.PopLimit(limit);
    return status;
  }

  static absl::Status TooMany() {
    return InvalidArgument(
        "message", absl::StrCat("at most ", kMaxElements, " messages, strings and unknown fields"),
        "more");
  }

  google::protobuf::io::CodedInputStream input_;
  int64_t elements_ = 0;
};

}  // namespace

absl::Status ParseRequest(absl::string_view bytes, google::protobuf::Message* request) {
  const bool may_exceed = static_cast<int64_t>(bytes.size()) > kShortestElement * kMaxElements;
  const Descriptor& type = *request->GetDescriptor();
  // The items that a short request for a decision may have occupy little memory, and it has no
  // time to lose.
  const bool is_short_act = bytes.size() <= kShortAct && &type == v1::ActRequest::descriptor();
  if (may_exceed || (!is_short_act && HasItems(type))) {
    RETURN_IF_ERROR(ElementChecker(bytes).Check(&type));
  }
  if (request->ParseFromArray(bytes.data(), static_cast<int>(bytes.size()))) {
    return absl::OkStatus();
  }
  return absl::InternalError(
      "message: expected a request of this method, received bytes that are none");
}

}  // namespace spikeserve
