#include "server/transport/grpc_stream.h"

#include <algorithm>
#include <cstring>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/contract/dcheck.h"
#include "server/transport/grpc_wire.h"
#include "server/transport/limits.h"

namespace spikeserve {
namespace {

// RFC 9113, section 6.5.2: the size of a header is that of its name and its value, plus 32.
constexpr int64_t kHeaderOverhead = 32;

// A client whose headers exceed the limit by this factor loses its connection: taking its headers
// apart costs time, although they are not stored.
constexpr int64_t kHostileHeaders = 4;

// What a call occupies beside its headers and messages: the stream, that of nghttp2, the handler.
constexpr int64_t kStreamBytes = 3 << 10;

// Headers that arrive slowly are counted in steps of this size.
constexpr int64_t kHeaderStep = 4 << 10;

constexpr char kContentType[] = "application/grpc";

nghttp2_nv Header(absl::string_view name, absl::string_view value) {
  return {.name = reinterpret_cast<uint8_t*>(const_cast<char*>(name.data())),
          .value = reinterpret_cast<uint8_t*>(const_cast<char*>(value.data())),
          .namelen = name.size(),
          .valuelen = value.size(),
          .flags = NGHTTP2_NV_FLAG_NONE};  // nghttp2 copies both
}

// Appends the headers that carry the status of a call. `status` must outlive `headers`.
void Append(const StatusHeaders& status, std::vector<nghttp2_nv>* headers) {
  headers->push_back(Header("grpc-status", status.code));
  if (!status.message.empty()) headers->push_back(Header("grpc-message", status.message));
  if (!status.details.empty()) {
    headers->push_back(Header("grpc-status-details-bin", status.details));
  }
}

ssize_t ReadCallback(nghttp2_session* /*session*/, int32_t /*id*/, uint8_t* out, size_t size,
                     uint32_t* flags, nghttp2_data_source* source, void* /*connection*/) {
  return static_cast<GrpcStream*>(source->ptr)->ReadAnswer(out, size, flags);
}

}  // namespace

GrpcStream::GrpcStream(Owner* owner, nghttp2_session* session, int32_t id)
    : owner_(owner), session_(session), id_(id), tenant_(owner->tenant()) {
  CountStored();
}

GrpcStream::~GrpcStream() {
  SPIKESERVE_DCHECK(answer_state_ == AnswerState::kClosed);
  Count(-counted_);
  owner_->CountBytes(-counted_here_);
  owner_->CountAnswers(-counted_answers_);
}

bool GrpcStream::AddHeader(absl::string_view name, absl::string_view value) {
  header_bytes_ += static_cast<int64_t>(name.size() + value.size()) + kHeaderOverhead;
  ++headers_;
  const TransportLimits& limits = owner_->limits();
  if (header_bytes_ >= header_bytes_to_count_) {
    header_bytes_to_count_ = header_bytes_ + kHeaderStep;
    CountStored();
  }
  if (header_bytes_ > limits.max_header_bytes || headers_ > limits.max_headers) {
    return header_bytes_ <= kHostileHeaders * limits.max_header_bytes &&
           headers_ <= kHostileHeaders * limits.max_headers;
  }
  if (name == ":path") {
    head_.path.assign(value.data(), value.size());
  } else if (name == ":method") {
    http_method_.assign(value.data(), value.size());
  } else if (name == "authorization") {
    head_.authorization.assign(value.data(), value.size());
  } else if (name == "content-type") {
    content_type_.assign(value.data(), value.size());
  } else if (name == "grpc-timeout") {
    timeout_.assign(value.data(), value.size());
  } else if (name == "grpc-encoding") {
    encoding_.assign(value.data(), value.size());
  } else if (name == "traceparent") {
    head_.trace = ParseTraceParent(value);
  }
  return true;
}

void GrpcStream::StartCall() {
  SPIKESERVE_DCHECK(handler_ == nullptr && answer_state_ == AnswerState::kNone);  // called once
  const TransportLimits& limits = owner_->limits();
  if (header_bytes_ > limits.max_header_bytes || headers_ > limits.max_headers) {
    return SubmitTrailersOnly(absl::ResourceExhaustedError(absl::StrCat(
        "metadata: expected at most ", limits.max_header_bytes, " bytes and ", limits.max_headers,
        " headers, received ", header_bytes_, " bytes and ", headers_, " headers")));
  }
  if (http_method_ != "POST") {
    return RefuseHttp("405", "expected POST, the method of gRPC\n");
  }
  if (!IsGrpcContentType(content_type_)) {
    return RefuseHttp("415", "content-type: expected application/grpc\n");
  }
  if (!encoding_.empty() && encoding_ != "identity" && encoding_ != "gzip") {
    return SubmitTrailersOnly(absl::UnimplementedError(
        absl::StrCat("grpc-encoding: expected identity or gzip, received ", encoding_)));
  }
  if (!timeout_.empty()) {
    const auto timeout = ParseTimeout(timeout_);
    if (!timeout.ok()) return SubmitTrailersOnly(timeout.status());
    head_.deadline = loop().now() + *timeout;
    deadline_timer_ = loop().After(*timeout, [this] {
      Finish(absl::DeadlineExceededError("the call's deadline has passed"));
    });
  }
  handler_ = owner_->router().Route(this);
  if (!CountStored() && !within_group_) RefuseForBytes();
}

void GrpcStream::OnData(absl::string_view data) {
  if (handler_ == nullptr || is_finished() || dropping_) {
    // Only the connection's window opens again, so that the client soon stops sending.
    nghttp2_session_consume_connection(session_, data.size());
    return owner_->WantFlush();
  }
  if (!reading() || !unread_.empty()) {
    unread_.append(data.data(), data.size());
  } else {
    const absl::string_view rest = Deliver(data);
    Consume(data.size() - rest.size());
    unread_.assign(rest.data(), rest.size());
  }
  BoundRequest();
  if (!unread_.empty() && !owner_->MayRead()) owner_->ReadOnLater(id_);
}

absl::string_view GrpcStream::Deliver(absl::string_view data) {
  delivering_ = true;
  while (reading()) {
    const auto item = reader_.Next(&data, handler_->message_limit());
    if (!item.has_value()) break;
    incomplete_since_ = absl::InfiniteDuration();
    if (item->too_long) {
      handler_->OnTooLong(item->length);
    } else if (item->compressed) {
      DeliverCompressed(item->message);
    } else {
      handler_->OnMessage(item->message);
    }
  }
  delivering_ = false;
  if (is_finished()) return {};
  if (reader_.at_boundary()) {
    incomplete_since_ = absl::InfiniteDuration();
  } else {
    incomplete_since_ = std::min(incomplete_since_, loop().now());
  }
  return data;
}

void GrpcStream::DeliverCompressed(absl::string_view message) {
  const auto bytes = Decompress(encoding_, message, handler_->message_limit());
  bytes.ok() ? handler_->OnMessage(*bytes) : Finish(bytes.status());
}

void GrpcStream::ReadOn() {
  if (delivering_ || handler_ == nullptr || is_finished()) return;
  if (!owner_->MayRead()) return owner_->ReadOnLater(id_);
  if (!reading()) return;
  if (!unread_.empty()) {
    const std::string data = std::exchange(unread_, {});
    const absl::string_view rest = Deliver(data);
    Consume(data.size() - rest.size());
    unread_.assign(rest.data(), rest.size());
    BoundRequest();
    if (!unread_.empty() && !owner_->MayRead()) owner_->ReadOnLater(id_);
  }
  if (request_state_ != RequestState::kOpen) OnHalfClose();
}

void GrpcStream::OnHalfClose() {
  if (request_state_ == RequestState::kOpen) request_state_ = RequestState::kHalfClosed;
  incomplete_since_ = absl::InfiniteDuration();
  if (!http_refusal_.empty() && !is_finished()) return SendHttpRefusal();
  if (handler_ == nullptr || is_finished() || request_state_ == RequestState::kEnded) return;
  if (!unread_.empty() || !reading()) {  // ReadOn() continues
    if (!owner_->MayRead()) owner_->ReadOnLater(id_);
    return;
  }
  request_state_ = RequestState::kEnded;
  if (!reader_.at_boundary()) {
    return Finish(absl::InternalError("message: expected all of its bytes, received END_STREAM"));
  }
  handler_->OnHalfClose();
}

void GrpcStream::OnClosed() {
  SPIKESERVE_DCHECK(answer_state_ != AnswerState::kClosed);
  answer_state_ = AnswerState::kClosed;
  loop().Cancel(deadline_timer_);
  if (const auto handler = std::exchange(handler_, nullptr)) handler->OnClosed();
}

void GrpcStream::OnDrain() {
  if (handler_ != nullptr && !is_finished()) handler_->OnDrain();
}

void GrpcStream::Admit(std::shared_ptr<ByteBudget> tenant) {
  loop().thread().AssertCurrent();
  CountFor(tenant);
  owner_->MarkKnown(tenant);
}

void GrpcStream::CountFor(const std::shared_ptr<ByteBudget>& tenant) {
  const int64_t bytes = counted_;
  Count(-bytes);
  tenant_ = tenant;
  Count(bytes);
}

bool GrpcStream::Hold(int64_t bytes) {
  loop().thread().AssertCurrent();
  const int64_t added = bytes - std::exchange(held_, bytes);
  counted_ += added;
  return Count(added);
}

void GrpcStream::ResumeReading() {
  loop().thread().AssertCurrent();
  paused_ = false;
  ReadOn();
}

void GrpcStream::Consume(size_t bytes) {
  if (bytes == 0) return;
  nghttp2_session_consume(session_, id_, bytes);
  owner_->WantFlush();
}

bool GrpcStream::Count(int64_t bytes) {
  within_group_ = tenant_ == nullptr ? owner_->CountUnauthenticatedBytes(bytes)
                                     : tenant_->Count(bytes, owner_->limits().max_tenant_bytes);
  return owner_->CountProcessBytes(bytes) && within_group_;
}

bool GrpcStream::CountStored() {
  const auto answers = static_cast<int64_t>(answer_.size());
  const auto request = static_cast<int64_t>(reader_.buffered() + unread_.size());
  const int64_t headers = std::min(header_bytes_, owner_->limits().max_header_bytes);
  const int64_t here = kStreamBytes + headers + request + answers;
  owner_->CountAnswers(answers - std::exchange(counted_answers_, answers));
  const bool connection_admits = owner_->CountBytes(here - std::exchange(counted_here_, here));
  const int64_t all = here + held_;
  return Count(all - std::exchange(counted_, all)) && connection_admits;
}

void GrpcStream::BoundRequest() {
  if (CountStored() || is_finished() || (reader_.buffered() == 0 && unread_.empty())) return;
  unread_ = {};
  reader_ = {};
  CountStored();
  RefuseForBytes();
}

void GrpcStream::RefuseForBytes() { Finish(TooManyBytesError()); }

void GrpcStream::Send(const google::protobuf::MessageLite& message) {
  loop().thread().AssertCurrent();
  if (is_finished()) return;
  if (sent_ > kUnsentLimit) {
    answer_.erase(0, sent_);
    sent_ = 0;
  }
  AppendMessage(message, &answer_);
  SubmitAnswer();
}

void GrpcStream::SendFramed(std::string framed) {
  loop().thread().AssertCurrent();
  if (is_finished()) return;
  if (unsent() == 0) {
    answer_ = std::move(framed);
    sent_ = 0;
  } else {
    answer_ += framed;
  }
  SubmitAnswer();
}

void GrpcStream::SubmitAnswer() {
  unsent_since_ = std::min(unsent_since_, loop().now());
  BoundRequest();
  SubmitData();
}

void GrpcStream::Finish(const absl::Status& status) {
  loop().thread().AssertCurrent();
  if (is_finished()) return;
  if (!http_refusal_.empty()) return SendHttpRefusal();
  loop().Cancel(deadline_timer_);
  if (answer_state_ == AnswerState::kNone) return SubmitTrailersOnly(status);
  status_ = status;
  SubmitData();
  answer_state_ = AnswerState::kFinished;
}

void GrpcStream::SubmitData() {
  owner_->WantFlush();
  const AnswerState before = answer_state_;
  if (is_finished()) return;
  answer_state_ = AnswerState::kSending;
  if (before == AnswerState::kWaiting) {
    nghttp2_session_resume_data(session_, id_);
  } else if (before == AnswerState::kNone) {
    SubmitWithData({Header(":status", "200"), Header("content-type", kContentType)});
  }
}

void GrpcStream::SubmitTrailersOnly(const absl::Status& status) {
  SPIKESERVE_DCHECK(answer_state_ == AnswerState::kNone);
  answer_state_ = AnswerState::kFinished;
  const StatusHeaders status_headers = StatusHeadersOf(status);
  std::vector<nghttp2_nv> headers = {Header(":status", "200"),
                                     Header("content-type", kContentType)};
  if (status.code() == absl::StatusCode::kUnimplemented) {
    headers.push_back(Header("grpc-accept-encoding", kAcceptedEncodings));
  }
  Append(status_headers, &headers);
  nghttp2_submit_response(session_, id_, headers.data(), headers.size(), nullptr);
  owner_->WantFlush();
}

void GrpcStream::RefuseHttp(absl::string_view http_status, absl::string_view body) {
  http_refusal_ = std::string(http_status);
  answer_.assign(body.data(), body.size());
  incomplete_since_ = loop().now();
}

void GrpcStream::SendHttpRefusal() {
  SPIKESERVE_DCHECK(answer_state_ == AnswerState::kNone);
  answer_state_ = AnswerState::kFinished;
  std::vector<nghttp2_nv> headers = {Header(":status", http_refusal_),
                                     Header("content-type", "text/plain")};
  if (http_refusal_ == "405") headers.push_back(Header("allow", "POST"));
  if (http_method_ != "HEAD") return SubmitWithData(headers);
  nghttp2_submit_response(session_, id_, headers.data(), headers.size(), nullptr);
  owner_->WantFlush();
}

void GrpcStream::SubmitWithData(const std::vector<nghttp2_nv>& headers) {
  nghttp2_data_provider provider = {.source = {.ptr = this}, .read_callback = &ReadCallback};
  nghttp2_submit_response(session_, id_, headers.data(), headers.size(), &provider);
  owner_->WantFlush();
}

void GrpcStream::FreeAnswers() {
  answer_.clear();
  if (answer_.capacity() > kUnsentLimit) answer_.shrink_to_fit();
  sent_ = 0;
  CountStored();
}

ssize_t GrpcStream::ReadAnswer(uint8_t* out, size_t size, uint32_t* flags) {
  const bool was_full = unsent() > kUnsentLimit;
  const size_t count = std::min(size, unsent());
  std::memcpy(out, answer_.data() + sent_, count);
  sent_ += count;
  if (count > 0) unsent_since_ = unsent() > 0 ? loop().now() : absl::InfiniteDuration();
  if (was_full && unsent() <= kUnsentLimit) owner_->ReadOnLater(id_);
  if (unsent() > 0) return static_cast<ssize_t>(count);
  FreeAnswers();
  if (is_finished()) {
    *flags |= NGHTTP2_DATA_FLAG_EOF;
    if (!http_refusal_.empty()) return static_cast<ssize_t>(count);
    *flags |= NGHTTP2_DATA_FLAG_NO_END_STREAM;
    const StatusHeaders status_headers = StatusHeadersOf(status_);
    std::vector<nghttp2_nv> trailers;
    Append(status_headers, &trailers);
    nghttp2_submit_trailer(session_, id_, trailers.data(), trailers.size());
    return static_cast<ssize_t>(count);
  }
  if (count > 0) return static_cast<ssize_t>(count);
  answer_state_ = AnswerState::kWaiting;
  return NGHTTP2_ERR_DEFERRED;
}

}  // namespace spikeserve
