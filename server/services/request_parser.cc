#include "server/services/request_parser.h"

#include <google/protobuf/descriptor.h>
#include <google/protobuf/io/coded_stream.h>
#include <google/protobuf/wire_format_lite.h>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

using google::protobuf::Descriptor;
using google::protobuf::FieldDescriptor;
using google::protobuf::internal::WireFormatLite;

// The shortest element: a tag and a length of zero.
constexpr int64_t kShortestElement = 2;

// Counts the elements of one request and of the messages in it.
class ElementCounter {
 public:
  explicit ElementCounter(absl::string_view bytes)
      : input_(reinterpret_cast<const uint8_t*>(bytes.data()), static_cast<int>(bytes.size())) {}

  // Returns false if a message of `type` has more than kMaxElements elements. Stops at the first
  // byte that cannot be read, where the parser stops, too.
  bool Fits(const Descriptor* type) {
    int groups = 0;  // that are open; what is in them is unknown
    while (const uint32_t tag = input_.ReadTag()) {
      const FieldDescriptor* field =
          groups > 0 ? nullptr : type->FindFieldByNumber(WireFormatLite::GetTagFieldNumber(tag));
      const auto form = WireFormatLite::GetTagWireType(tag);
      const bool has_length = form == WireFormatLite::WIRETYPE_LENGTH_DELIMITED;
      if ((field == nullptr || has_length) && ++elements_ > kMaxElements) return false;
      if (form == WireFormatLite::WIRETYPE_START_GROUP) {
        ++groups;
      } else if (form == WireFormatLite::WIRETYPE_END_GROUP) {
        --groups;
      } else if (has_length && field != nullptr && field->message_type() != nullptr) {
        if (!FitsNested(field->message_type())) return false;
      } else if (!WireFormatLite::SkipField(&input_, tag)) {
        return true;
      }
    }
    return true;
  }

 private:
  bool FitsNested(const Descriptor* type) {
    uint32_t length = 0;
    if (!input_.ReadVarint32(&length)) return true;
    const auto limit = input_.PushLimit(static_cast<int>(length));
    const bool fits = Fits(type);
    input_.PopLimit(limit);
    return fits;
  }

  google::protobuf::io::CodedInputStream input_;
  int64_t elements_ = 0;
};

}  // namespace

absl::Status ParseRequest(absl::string_view bytes, google::protobuf::Message* request) {
  const bool may_exceed = static_cast<int64_t>(bytes.size()) > kShortestElement * kMaxElements;
  if (may_exceed && !ElementCounter(bytes).Fits(request->GetDescriptor())) {
    return absl::InvalidArgumentError(
        absl::StrCat("message: expected at most ", kMaxElements,
                     " messages, strings and unknown fields, received more"));
  }
  if (request->ParseFromArray(bytes.data(), static_cast<int>(bytes.size()))) {
    return absl::OkStatus();
  }
  return absl::InternalError(
      "message: expected a request of this method, received bytes that are none");
}

}  // namespace spikeserve
