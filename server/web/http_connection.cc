#include "server/web/http_connection.h"

#include <sys/epoll.h>

#include <algorithm>
#include <array>
#include <boost/beast/http/buffer_body.hpp>
#include <boost/beast/http/parser.hpp>
#include <limits>
#include <utility>
#include <variant>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/types/span.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "server/base/address.h"

namespace spikeserve {
namespace {

namespace http = boost::beast::http;

constexpr absl::Duration kRequestTimeout = absl::Seconds(5);
constexpr absl::Duration kBodyTimeout = absl::Seconds(30);
constexpr absl::Duration kAnswerTimeout = absl::Minutes(2);
constexpr absl::Duration kWriteTimeout = absl::Seconds(30);
constexpr absl::Duration kClosingTimeout = absl::Seconds(1);
constexpr absl::Duration kFeedInterval = absl::Milliseconds(50);

constexpr uint32_t kMaxHeaderBytes = 16 << 10;
constexpr size_t kReadBytes = 4 << 10;
constexpr size_t kWriteBytes = 64 << 10;  // at a time, so that connections take turns
constexpr size_t kMaxDropped = 16 << 20;  // more than most bodies that are too long

constexpr absl::string_view kContinue = "HTTP/1.1 100 Continue\r\n\r\n";

// Returns true if the header Host names this machine, with or without a port.
bool NamesThisMachine(absl::string_view host) {
  return Address{.host = std::string(WithoutPort(host))}.is_loopback();
}

// Converts a string view of the library.
template <typename View>
absl::string_view ToView(const View& view) {
  return {view.data(), view.size()};
}

}  // namespace

struct HttpConnection::Parser : http::request_parser<http::buffer_body> {};

HttpConnection::HttpConnection(std::unique_ptr<Socket> socket, std::unique_ptr<ConnectionSlot> slot,
                               const HttpOptions& options, Owner* owner)
    : socket_(std::move(socket)),
      slot_(std::move(slot)),
      options_(options),
      owner_(owner),
      parser_(std::make_unique<Parser>()) {
  parser_->header_limit(kMaxHeaderBytes);
  parser_->body_limit(std::numeric_limits<uint64_t>::max());  // which TakeBody() checks
}

HttpConnection::~HttpConnection() { SPIKESERVE_DCHECK(state_ == State::kClosed); }

absl::Status HttpConnection::Start() {
  RETURN_IF_ERROR(events().Watch(socket_->fd(), EPOLLIN, this));
  Enter(State::kReading, kRequestTimeout, EPOLLIN);
  return absl::OkStatus();
}

void HttpConnection::Enter(State state, absl::Duration timeout, uint32_t events_to_watch) {
  state_ = state;
  events().Cancel(timer_);
  timer_ = events().After(timeout, [this] { OnTimeout(); });
  events().ChangeWatch(socket_->fd(), events_to_watch, this);
}

void HttpConnection::OnTimeout() {
  if (state_ == State::kFeeding) return Feed();
  if (state_ != State::kDelaying) return Close();
  Enter(State::kWriting, kWriteTimeout, EPOLLOUT);
  Write();
}

void HttpConnection::Close() {
  events().thread().AssertCurrent();
  if (std::exchange(state_, State::kClosed) == State::kClosed) return;
  request_.held.reset();
  events().Cancel(timer_);
  events().Unwatch(socket_->fd());
  owner_->OnClosed(this);
}

void HttpConnection::OnReady(uint32_t ready) {
  const bool waits = state_ == State::kAnswering || state_ == State::kDelaying;
  if (waits && (ready & (EPOLLHUP | EPOLLERR)) != 0) return Close();
  if (state_ == State::kReading || state_ == State::kReadingBody) return Read();
  if (state_ == State::kWriting) return Write();
  if (state_ == State::kFeeding || state_ == State::kClosing) return DropInput();
}

void HttpConnection::Read() {
  std::array<char, kReadBytes> buffer;
  do {
    const Socket::Result result = socket_->Read(absl::MakeSpan(buffer));
    if (result.outcome == Socket::Outcome::kClosed) return Close();
    if (result.outcome == Socket::Outcome::kBlocked) {
      const uint32_t wanted = socket_->read_waits_for_write() ? EPOLLOUT : EPOLLIN;
      return events().ChangeWatch(socket_->fd(), wanted, this);
    }
    input_.append(buffer.data(), result.bytes);
    state_ == State::kReading ? Parse() : TakeBody();
  } while ((state_ == State::kReading || state_ == State::kReadingBody) &&
           socket_->has_buffered_input());
}

void HttpConnection::Parse() {
  boost::system::error_code error;
  const size_t parsed = parser_->put(boost::asio::buffer(input_), error);
  input_.erase(0, parsed);
  if (error == http::error::need_more) return;
  if (error == http::error::header_limit) {
    return Answer({.code = 431, .body = "headers: expected at most 16 KiB\n"});
  }
  if (error) return Answer({.code = 400, .body = "expected a request of HTTP/1.1\n"});
  if (parser_->is_header_done()) ParseHeaders();
}

void HttpConnection::ParseHeaders() {
  const auto& headers = parser_->get();
  is_head_ = headers.method() == http::verb::head;
  request_.is_post = headers.method() == http::verb::post;
  const bool is_preflight = headers.method() == http::verb::options &&
                            headers.count(http::field::access_control_request_method) > 0;
  if (headers.method() != http::verb::get && !is_head_ && !request_.is_post && !is_preflight) {
    return Answer({.code = 405, .body = "expected GET or HEAD\n"});
  }
  // A browser always sends the header; some programs that check health do not.
  if (headers.count(http::field::host) > 1) {
    return Answer({.code = 400, .body = "Host: expected one header, received several\n"});
  }
  const absl::string_view origin = ToView(headers[http::field::origin]);
  const auto target_host = is_preflight ? "" : DecodeTarget(ToView(headers.target()), &request_);
  if (!target_host.ok()) {
    return Answer({.code = 400, .body = std::string(target_host.status().message()) + "\n"});
  }
  const auto host = headers.find(http::field::host);
  if (options_.local_names_only &&
      ((host != headers.end() && !NamesThisMachine(ToView(host->value()))) ||
       (!target_host->empty() && !NamesThisMachine(*target_host)))) {
    return Answer({.code = 403, .body = "Host: expected localhost or a loopback address\n"});
  }
  origin_headers_ = options_.origins.HeadersFor(origin);
  if (is_preflight) return Answer(options_.origins.Preflight(origin));
  StoreHeaders();
  request_.is_post ? StartBody() : Submit();
}

void HttpConnection::StoreHeaders() {
  const auto& headers = parser_->get();
  request_.authorization = std::string(ToView(headers[http::field::authorization]));
  request_.trace = ParseTraceParent(ToView(headers["traceparent"]));
  request_.content_type = std::string(ToView(headers[http::field::content_type]));
  request_.grpc_timeout = std::string(ToView(headers["grpc-timeout"]));
  request_.json_length = std::string(ToView(headers["Inference-Header-Content-Length"]));
  request_.peer.address = slot_->address();
  request_.client = client_;
}

HttpResponse HttpConnection::CheckBodyHeaders() {
  const auto& headers = parser_->get();
  // Programs before this one may read a body with another header in another way.
  const absl::string_view transfer = ToView(headers[http::field::transfer_encoding]);
  const auto transfers = headers.count(http::field::transfer_encoding);
  const bool is_chunked = absl::EqualsIgnoreCase(transfer, "chunked") && headers.version() == 11;
  if (transfers > 1 || (transfers == 1 && !is_chunked)) {
    return JsonError(501, "Transfer-Encoding: expected none, or chunked with HTTP/1.1");
  }
  const auto length = parser_->content_length();
  if (!is_chunked && !length.has_value()) {
    return JsonError(411, "Content-Length: expected the length of the body, received none");
  }
  const absl::string_view encoding = ToView(headers[http::field::content_encoding]);
  request_.is_gzip =
      absl::EqualsIgnoreCase(encoding, "gzip") || absl::EqualsIgnoreCase(encoding, "x-gzip");
  if (headers.count(http::field::content_encoding) > 1 ||
      (!request_.is_gzip && !encoding.empty() && !absl::EqualsIgnoreCase(encoding, "identity"))) {
    return JsonError(415, "Content-Encoding: expected gzip or none");
  }
  request_.body_length = static_cast<int64_t>(
      std::min<uint64_t>(length.value_or(0), std::numeric_limits<int64_t>::max()));
  return {.code = 0, .body = ""};
}

bool HttpConnection::MaySend() const {
  const auto& headers = parser_->get();
  if (headers.count(http::field::origin) == 0 || !origin_headers_.empty()) return true;
  const absl::string_view host = ToView(headers[http::field::host]);
  // A page of another site, whose name resolves to this server, has that name, but neither a token
  // for it nor a certificate.
  const bool is_safe = options_.has_tokens || options_.tls != nullptr || IsNobodyElses(host);
  return is_safe && headers.count(http::field::origin) == 1 &&
         IsOwnOrigin(ToView(headers[http::field::origin]), host, options_.tls != nullptr);
}

void HttpConnection::StartBody() {
  // A browser sends the header with what a page of any site lets it send.
  if (!MaySend()) {
    return Answer(
        JsonError(403, "Origin: expected none, that of this server, or one of --http_origins"));
  }
  HttpResponse refused_form = CheckBodyHeaders();
  request_.peer.certificate = socket_->peer_subject();
  auto accepted = owner_->AcceptBody(request_);
  if (const auto* refusal = std::get_if<HttpResponse>(&accepted)) return Answer(*refusal);
  if (refused_form.code != 0) return Answer(std::move(refused_form));
  auto& body = std::get<AcceptedBody>(accepted);
  request_.longest_body = body.longest;
  request_.caller = std::move(body.caller);
  request_.held = std::move(body.held);
  const bool waits =
      absl::EqualsIgnoreCase(ToView(parser_->get()[http::field::expect]), "100-continue");
  Enter(State::kReadingBody, kBodyTimeout, EPOLLIN);
  if (waits && input_.empty() && !parser_->is_done()) {
    // Nothing was written before, so there is room for these bytes.
    if (socket_->Write(kContinue).bytes != kContinue.size()) return Close();
  }
  parser_->eager(true);  // takes all chunks that have arrived at once
  TakeBody();
}

void HttpConnection::TakeBody() {
  std::array<char, kReadBytes> piece;
  bool took = true;
  while (took && !input_.empty() && !parser_->is_done()) {
    auto& body = parser_->get().body();
    body.data = piece.data();
    body.size = piece.size();
    boost::system::error_code error;
    const size_t parsed = parser_->put(boost::asio::buffer(input_), error);
    took = parsed > 0;
    input_.erase(0, parsed);
    request_.body.append(piece.data(), piece.size() - body.size);
    if (error && error != http::error::need_more && error != http::error::need_buffer) {
      return Answer(JsonError(400, "body: expected chunks of HTTP/1.1"));
    }
  }
  const size_t bytes = request_.body.size();
  if (bytes > request_.longest_body + (request_.is_gzip ? size_t{kGzipOverhead} : 0)) {
    return Answer(JsonError(413, absl::StrCat("body: expected at most ", request_.longest_body,
                                              " bytes, received more")));
  }
  if (request_.held != nullptr && !request_.held->Set(static_cast<int64_t>(bytes))) {
    return Answer(
        {.code = 503, .body = "body: the server holds as many bytes as it may; try again later\n"});
  }
  if (parser_->is_done()) return Submit();
  // What is left is the line of a chunk, or fields behind the last one.
  if (input_.size() > kMaxHeaderBytes) Answer(JsonError(400, "body: expected chunks of HTTP/1.1"));
}

void HttpConnection::Submit() {
  parser_.reset();
  slot_->MarkCaller();
  Enter(State::kAnswering, kAnswerTimeout, 0);
  owner_->OnRequest(this, std::exchange(request_, {}));
}

void HttpConnection::Answer(HttpResponse response) {
  if (state_ == State::kClosed) return;
  output_ = HeadersOf(response, origin_headers_);
  if (!is_head_) {
    feed_ = std::move(response.feed);
    // A long body is not copied, and a short one needs no second packet.
    if (response.body.size() <= kWriteBytes) {
      output_ += response.body;
    } else {
      body_ = std::move(response.body);
    }
  }
  input_ = std::string();
  request_ = {};
  if (response.delay > absl::ZeroDuration()) return Enter(State::kDelaying, response.delay, 0);
  Enter(State::kWriting, kWriteTimeout, EPOLLOUT);
  Write();
}

void HttpConnection::Write() {
  while (written_ < output_.size()) {
    const auto rest = absl::string_view(output_).substr(written_, kWriteBytes);
    const Socket::Result result = socket_->Write(rest);
    if (result.outcome == Socket::Outcome::kClosed) return Close();
    if (result.outcome == Socket::Outcome::kBlocked) return;
    written_ += result.bytes;
  }
  written_ = 0;
  output_ = std::exchange(body_, {});
  if (!output_.empty()) return Write();
  if (feed_ != nullptr) return WaitForFeed();
  socket_->ShutDownWriting();
  Enter(State::kClosing, kClosingTimeout, EPOLLIN);
}

void HttpConnection::WaitForFeed() { Enter(State::kFeeding, kFeedInterval, EPOLLIN); }

void HttpConnection::Feed() {
  std::optional<std::string> next = feed_->Next();
  if (!next.has_value()) return EndFeed();
  if (next->empty()) return WaitForFeed();
  output_ = *std::move(next);
  written_ = 0;
  Enter(State::kWriting, kWriteTimeout, EPOLLOUT);
  Write();
}

void HttpConnection::EndFeed() {
  feed_.reset();
  if (state_ == State::kFeeding) Write();
}

void HttpConnection::DropInput() {
  std::array<char, kReadBytes> buffer;
  const Socket::Result result = socket_->Read(absl::MakeSpan(buffer));
  if (result.outcome == Socket::Outcome::kBlocked) return;
  dropped_ += result.bytes;
  if (result.outcome == Socket::Outcome::kClosed || dropped_ > kMaxDropped) Close();
}

}  // namespace spikeserve
