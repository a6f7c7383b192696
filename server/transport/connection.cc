#include "server/transport/connection.h"

#include <sys/epoll.h>

#include <array>
#include <utility>

#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "server/base/log.h"

namespace spikeserve {
namespace {

constexpr size_t kReadBytes = 16 << 10;   // at a time, a record of TLS
constexpr int kReadsPerStep = 16;         // then other connections get their turn
constexpr size_t kWriteBytes = 64 << 10;  // at a time
constexpr size_t kWriteStep = 256 << 10;  // then other connections get their turn

// The time after which a step of a connection ends; it may be exceeded by what one read brings.
constexpr absl::Duration kStepTime = absl::Microseconds(300);

// A connection stops reading while this many frames wait for the client to take them, for example
// acknowledgements of a flood of PINGs.
constexpr size_t kQueuedFrames = 1000;

// A connection that closes waits so long for its client to close, and reads so much.
constexpr absl::Duration kClosingTimeout = absl::Seconds(1);
constexpr size_t kMaxDropped = 1 << 20;

// The streams of a connection read no further messages while it stores more bytes of answers
// than this: less when all connections together use a quarter of their budget.
constexpr int64_t kStoredAnswers = 1 << 20;
constexpr int64_t kAnswersWhenScarce = 64 << 10;
constexpr int64_t kScarceFraction = 4;

// What an unauthenticated client may store on one connection: requests of methods that need no
// token are short.
constexpr int64_t kUnauthenticatedBytes = 1 << 20;

constexpr char kResetLimit[] = "--max_resets_per_second";
constexpr char kControlLimit[] = "--max_control_frames_per_second";

constexpr uint32_t kStreamWindow = 64 << 10;
constexpr int32_t kConnectionWindow = 1 << 20;

}  // namespace

Connection::Connection(std::unique_ptr<Socket> socket, std::unique_ptr<ConnectionSlot> slot,
                       Shared* shared)
    : socket_(std::move(socket)),
      slot_(std::move(slot)),
      shared_(shared),
      connected_(shared->loop->now()),
      last_active_(connected_),
      resets_(shared->limits->max_resets_per_second),
      control_frames_(shared->limits->max_control_frames_per_second) {
  nghttp2_session* session = nullptr;
  nghttp2_session_server_new3(&session, Callbacks(), this, SessionOption(),
                              frame_memory_.allocator());
  session_.reset(session);
  const TransportLimits& limits = *shared_->limits;
  const std::array<nghttp2_settings_entry, 3> settings = {{
      {NGHTTP2_SETTINGS_MAX_CONCURRENT_STREAMS, static_cast<uint32_t>(limits.max_streams)},
      {NGHTTP2_SETTINGS_INITIAL_WINDOW_SIZE, kStreamWindow},
      {NGHTTP2_SETTINGS_MAX_HEADER_LIST_SIZE, static_cast<uint32_t>(limits.max_header_bytes)},
  }};
  nghttp2_submit_settings(session, NGHTTP2_FLAG_NONE, settings.data(), settings.size());
  nghttp2_session_set_local_window_size(session, NGHTTP2_FLAG_NONE, 0, kConnectionWindow);
  CountOverhead(1);
}

Connection::~Connection() { SPIKESERVE_DCHECK(is_closed()); }

void Connection::Enter(State next) {
  SPIKESERVE_DCHECK(next > state_);
  state_ = next;
}

absl::Status Connection::Start() {
  SPIKESERVE_DCHECK_EQ(watched_, uint32_t{0});  // called once
  watched_ = EPOLLIN;
  RETURN_IF_ERROR(loop().Watch(socket_->fd(), watched_, this));
  WantFlush();
  return absl::OkStatus();
}

void Connection::OnReady(uint32_t events) {
  if (is_closed()) return;
  if (state_ == State::kClosing) return DropInput();
  if ((events & EPOLLOUT) != 0) WantFlush();
  const bool failed = (events & (EPOLLHUP | EPOLLERR)) != 0;
  if (waits_for_turn_) {
    if (failed) Close();
    return;
  }
  if (failed || (events & EPOLLIN) != 0 || socket_->read_waits_for_write()) ReadWhenDue();
}

void Connection::ReadWhenDue() {
  if (slot_->is_known()) return ReadAll();
  if (shared_->unauthenticated_queue.MayRun()) return OnTurn();
  waits_for_turn_ = true;
  UpdateWatch();
  shared_->unauthenticated_queue.Wait(this);
}

void Connection::OnTurn() {
  waits_for_turn_ = false;
  shared_->unauthenticated_queue.Run([this] {
    ReadStored();
    if (!is_closing()) ReadAll();
  });
}

void Connection::ReadAll() {
  thread_local std::array<char, kReadBytes> buffer;
  const absl::Duration end = shared_->clock->Now() + kStepTime;
  for (int i = 0; i < kReadsPerStep && shared_->clock->Now() < end; ++i) {
    const Socket::Result result = socket_->Read(absl::MakeSpan(buffer));
    if (result.outcome == Socket::Outcome::kClosed) return Close();
    if (result.outcome == Socket::Outcome::kBlocked) break;
    silent_checks_ = 0;
    if (!Receive({buffer.data(), result.bytes})) return;
    // Less than asked for: nothing more is there, and the attempt to read it costs a system call.
    if (result.bytes < buffer.size() && !socket_->has_buffered_input()) break;
  }
  if (socket_->has_buffered_input()) ContinueLater();  // epoll knows nothing of these bytes
  WantFlush();
}

void Connection::ContinueLater() {
  if (is_closed() || std::exchange(continues_, true)) return;
  if (shared_->to_continue.empty()) {
    loop().Post([shared = shared_] {
      for (Connection* connection : std::exchange(shared->to_continue, {})) connection->Continue();
    });
  }
  shared_->to_continue.push_back(this);
}

void Connection::Continue() {
  continues_ = false;
  if (is_closed() || waits_for_turn_) return;
  if (!slot_->is_known()) return ReadWhenDue();
  ReadStored();
  if (!is_closed() && socket_->has_buffered_input()) ReadAll();
}

void Connection::ReadStored() {
  const absl::Duration end = shared_->clock->Now() + kStepTime;
  std::vector<int32_t> ids = std::exchange(to_read_on_, {});
  while (!ids.empty() && !is_closed() && shared_->clock->Now() < end) {
    GrpcStream* const stream = FindStream(ids.back());
    ids.pop_back();
    if (stream != nullptr) stream->ReadOn();
  }
  if (is_closed() || ids.empty()) return;
  to_read_on_.insert(to_read_on_.end(), ids.begin(), ids.end());
  ContinueLater();
}

bool Connection::MayRead() const {
  if (answer_bytes_ == 0) return true;
  const TransportLimits& limits = *shared_->limits;
  const int64_t used = shared_->budgets->all.used();
  const bool exhausted = used > limits.max_bytes_in_flight ||
                         (tenant_ != nullptr && tenant_->used() > limits.max_tenant_bytes);
  if (exhausted) return false;
  const bool scarce = !slot_->is_known() || used > limits.max_bytes_in_flight / kScarceFraction;
  return answer_bytes_ <= (scarce ? kAnswersWhenScarce : kStoredAnswers);
}

void Connection::ReadOnLater(int32_t id) {
  to_read_on_.push_back(id);
  if (MayRead()) ContinueLater();  // otherwise when bytes have been sent, see Flush()
}

bool Connection::Receive(absl::string_view data) {
  const ssize_t received = nghttp2_session_mem_recv(
      session_.get(), reinterpret_cast<const uint8_t*>(data.data()), data.size());
  closed_streams_.clear();
  if (state_ == State::kCondemned) {
    Abort(NGHTTP2_ENHANCE_YOUR_CALM);
    return false;
  }
  if (received == NGHTTP2_ERR_BAD_CLIENT_MAGIC) {  // the client does not speak HTTP/2
    Close();
    return false;
  }
  if (received < 0) {
    Abort(received == NGHTTP2_ERR_FLOODED ? NGHTTP2_ENHANCE_YOUR_CALM : NGHTTP2_INTERNAL_ERROR);
    return false;
  }
  return true;
}

void Connection::WantFlush() {
  if (wants_flush_ || is_closed()) return;
  wants_flush_ = true;
  shared_->to_flush.push_back(this);
}

void Connection::Gather() {
  while (unsent_.size() < kWriteBytes) {
    const uint8_t* data = nullptr;
    const ssize_t size = nghttp2_session_mem_send(session_.get(), &data);
    if (size <= 0) return;
    has_buffers_ = true;
    unsent_.append(reinterpret_cast<const char*>(data), static_cast<size_t>(size));
  }
}

void Connection::Flush() {
  loop().thread().AssertCurrent();
  wants_flush_ = false;
  if (is_closing()) return;
  if (socket_->is_handshaking()) return UpdateWatch();  // writing would continue the handshake
  size_t flushed = 0;
  while (true) {
    if (unsent_.empty()) Gather();
    if (unsent_.empty() || flushed >= kWriteStep) break;
    const auto rest = absl::string_view(unsent_).substr(written_);
    const Socket::Result result = socket_->Write(rest);
    if (result.outcome == Socket::Outcome::kClosed) return Close();
    if (result.outcome == Socket::Outcome::kBlocked) {
      if (blocked_since_ == absl::InfiniteDuration()) blocked_since_ = loop().now();
      break;
    }
    blocked_since_ = absl::InfiniteDuration();
    written_ += result.bytes;
    flushed += result.bytes;
    if (written_ < unsent_.size()) continue;
    unsent_.clear();
    written_ = 0;
  }
  closed_streams_.clear();
  if (!to_read_on_.empty() && MayRead()) ContinueLater();
  const bool terminated = nghttp2_session_want_read(session_.get()) == 0 &&
                          nghttp2_session_want_write(session_.get()) == 0;
  const bool over = terminated || (state_ == State::kGoingAway && streams_.empty());
  if (unsent_.empty() && over) return CloseInOrder();
  UpdateWatch();
}

void Connection::UpdateWatch() {
  const bool backed_up =
      nghttp2_session_get_outbound_queue_size(session_.get()) > kQueuedFrames && !unsent_.empty();
  uint32_t events = backed_up || waits_for_turn_ ? 0U : static_cast<uint32_t>(EPOLLIN);
  if (!unsent_.empty() || socket_->read_waits_for_write()) events |= EPOLLOUT;
  if (events == watched_) return;
  watched_ = events;
  loop().ChangeWatch(socket_->fd(), events, this);
}

void Connection::CheckTimes() {
  if (is_closed()) return;
  const TransportLimits& limits = *shared_->limits;
  const absl::Duration now = loop().now();
  if (state_ == State::kClosing) {
    if (now - closing_since_ > kClosingTimeout) Close();
    return;
  }
  const bool never_called = !slot_->has_called() && now - connected_ > limits.first_request_timeout;
  bool stuck =
      now - blocked_since_ > limits.write_timeout || now - headers_since_ > limits.request_timeout;
  const bool idle = streams_.empty() && now - last_active_ > limits.idle_timeout;
  if (idle || now - connected_ > limits.max_connection_age) GoAway();
  for (const auto& [id, stream] : streams_) {
    stuck = stuck || now - stream->unsent_since() > limits.write_timeout;
    if (now - stream->incomplete_since() > limits.request_timeout) {
      stream->Finish(absl::DeadlineExceededError(
          "message: expected all of its bytes within --request_timeout, received a part"));
    }
  }
  if (never_called || stuck || !KeepAlive()) return Abort(NGHTTP2_NO_ERROR);
  if (has_buffers_ && streams_.empty() && unsent_.empty()) ReleaseBuffers();
}

bool Connection::KeepAlive() {
  // Checks are counted and not the time, because a process that was stopped has not listened.
  ++silent_checks_;
  if (streams_.empty()) return true;
  const TransportLimits& limits = *shared_->limits;
  const absl::Duration silent = silent_checks_ * kCheckInterval;
  const absl::Duration allowed = absl::Ceil(limits.keepalive_interval, kCheckInterval);
  if (silent == allowed) {
    nghttp2_submit_ping(session_.get(), NGHTTP2_FLAG_NONE, nullptr);
    WantFlush();
  }
  return silent <= allowed + absl::Ceil(limits.keepalive_timeout, kCheckInterval);
}

void Connection::ReleaseBuffers() {
  if (nghttp2_session_want_write(session_.get()) != 0) return;
  frame_memory_.Release();
  unsent_.shrink_to_fit();
  has_buffers_ = false;
}

void Connection::GoAway() {
  loop().thread().AssertCurrent();
  if (state_ != State::kOpen) return;
  Enter(State::kGoingAway);
  nghttp2_submit_goaway(session_.get(), NGHTTP2_FLAG_NONE,
                        nghttp2_session_get_last_proc_stream_id(session_.get()), NGHTTP2_NO_ERROR,
                        nullptr, 0);
  WantFlush();
}

void Connection::Drain() {
  loop().thread().AssertCurrent();
  std::vector<int32_t> ids;  // handlers may close streams
  for (const auto& [id, stream] : streams_) ids.push_back(id);
  for (const int32_t id : ids) {
    if (GrpcStream* stream = FindStream(id)) stream->OnDrain();
  }
}

void Connection::Abort(uint32_t error) {
  if (is_closing()) return;
  if (socket_->is_handshaking()) return Close();  // there is nothing to tell the client yet
  nghttp2_session_terminate_session(session_.get(), error);
  Gather();
  if (!unsent_.empty()) socket_->Write(absl::string_view(unsent_).substr(written_));
  CloseInOrder();
}

void Connection::CloseInOrder() {
  if (is_closing()) return;
  Enter(State::kClosing);
  closing_since_ = loop().now();
  CloseStreams();
  socket_->ShutDownWriting();
  watched_ = EPOLLIN;
  loop().ChangeWatch(socket_->fd(), watched_, this);
}

void Connection::DropInput() {
  std::array<char, 4096> buffer;
  while (dropped_ < kMaxDropped) {
    const Socket::Result result = socket_->Read(absl::MakeSpan(buffer));
    if (result.outcome == Socket::Outcome::kBlocked) return;
    if (result.outcome == Socket::Outcome::kClosed) break;
    dropped_ += result.bytes;
  }
  Close();
}

void Connection::CloseStreams() {
  for (auto& [id, stream] : std::exchange(streams_, {})) {
    nghttp2_session_set_stream_user_data(session_.get(), id, nullptr);
    stream->OnClosed();
  }
}

void Connection::Close() {
  loop().thread().AssertCurrent();
  if (is_closed()) return;
  Enter(State::kClosed);
  loop().Unwatch(socket_->fd());
  CloseStreams();
  if (continues_) std::erase(shared_->to_continue, this);
  if (waits_for_turn_) shared_->unauthenticated_queue.Remove(this);
  slot_->MarkFreed();
  if (!slot_->is_known()) CountOverhead(-1);
  shared_->closed(this);
}

void Connection::Drop() {
  loop().thread().AssertCurrent();
  if (is_closed()) return;
  if (state_ != State::kClosing && !socket_->is_handshaking()) {
    nghttp2_session_terminate_session(session_.get(), NGHTTP2_ENHANCE_YOUR_CALM);
    Gather();
    if (!unsent_.empty()) socket_->Write(absl::string_view(unsent_).substr(written_));
  }
  Close();
}

bool Connection::CountBytes(int64_t bytes) {
  bytes_ += bytes;
  return bytes <= 0 || bytes_ <= shared_->limits->max_connection_bytes;
}

bool Connection::CountUnauthenticatedBytes(int64_t bytes) {
  unauthenticated_bytes_ += bytes;
  ByteBudget& budget = shared_->budgets->unauthenticated;
  const int64_t limit = shared_->limits->max_unauthenticated_bytes;
  if (!budget.Count(bytes, limit)) {
    slot_->table().DropUnauthenticated(ConnectionLimit::kUnauthenticatedBytes,
                                       budget.used() - limit);
  }
  return bytes <= 0 || unauthenticated_bytes_ <= kUnauthenticatedBytes;
}

bool Connection::CountProcessBytes(int64_t bytes) {
  return shared_->budgets->all.Count(bytes, shared_->limits->max_bytes_in_flight);
}

void Connection::CountOverhead(int sign) {
  CountUnauthenticatedBytes(sign * (kConnectionBytes + socket_->overhead()));
}

void Connection::MarkKnown(const std::shared_ptr<ByteBudget>& tenant) {
  if (tenant_ == tenant) return;
  tenant_ = tenant;
  if (slot_->is_known()) return;
  slot_->MarkKnown();
  CountOverhead(-1);
  for (const auto& [id, stream] : streams_) stream->CountFor(tenant);
}

GrpcStream* Connection::FindStream(int32_t id) {
  return static_cast<GrpcStream*>(nghttp2_session_get_stream_user_data(session_.get(), id));
}

int Connection::OnBeginHeaders(int32_t id) {
  auto stream = std::make_unique<GrpcStream>(this, session_.get(), id);
  nghttp2_session_set_stream_user_data(session_.get(), id, stream.get());
  streams_.emplace(id, std::move(stream));
  last_active_ = loop().now();
  return 0;
}

int Connection::OnHeader(int32_t id, absl::string_view name, absl::string_view value) {
  GrpcStream* stream = FindStream(id);
  if (stream == nullptr || stream->AddHeader(name, value)) return 0;
  return CloseOverLimit("--max_header_bytes");
}

int Connection::CloseOverLimit(absl::string_view limit) {
  if (state_ < State::kCondemned) Enter(State::kCondemned);
  LogWarning("connection closed, because its client has exceeded a limit",
             {{"client", slot_->address()}, {"limit", limit}});
  return NGHTTP2_ERR_CALLBACK_FAILURE;
}

int Connection::ChargeFrame(FrameBudget* budget, absl::string_view limit) {
  return budget->Take(loop().now()) ? 0 : CloseOverLimit(limit);
}

int Connection::OnFrame(const nghttp2_frame& frame) {
  const bool ends_stream = (frame.hd.flags & NGHTTP2_FLAG_END_STREAM) != 0;
  GrpcStream* stream = nullptr;
  switch (frame.hd.type) {
    case NGHTTP2_HEADERS:
      headers_since_ = absl::InfiniteDuration();
      stream = FindStream(frame.hd.stream_id);
      if (stream == nullptr) return 0;
      if (frame.headers.cat == NGHTTP2_HCAT_REQUEST) {
        stream->StartCall();
        slot_->MarkCaller();
      }
      if (ends_stream) stream->OnHalfClose();
      return 0;
    case NGHTTP2_DATA:
      stream = FindStream(frame.hd.stream_id);
      if (ends_stream && stream != nullptr) stream->OnHalfClose();
      return frame.hd.length == 0 && !ends_stream ? ChargeFrame(&control_frames_, kControlLimit)
                                                  : 0;
    case NGHTTP2_RST_STREAM:
      return ChargeFrame(&resets_, kResetLimit);
    case NGHTTP2_PING:
    case NGHTTP2_SETTINGS:
      return (frame.hd.flags & NGHTTP2_FLAG_ACK) != 0
                 ? 0
                 : ChargeFrame(&control_frames_, kControlLimit);
    default:  // PRIORITY, WINDOW_UPDATE and extensions
      return ChargeFrame(&control_frames_, kControlLimit);
  }
}

int Connection::OnInvalidFrame() { return ChargeFrame(&resets_, kResetLimit); }

int Connection::OnDataChunk(int32_t id, absl::string_view data) {
  GrpcStream* stream = FindStream(id);
  if (stream == nullptr) {
    nghttp2_session_consume_connection(session_.get(), data.size());
  } else {
    stream->OnData(data);
  }
  return 0;
}

int Connection::OnStreamClosed(int32_t id) {
  const auto found = streams_.find(id);
  if (found == streams_.end()) return 0;
  found->second->OnClosed();
  closed_streams_.push_back(std::move(found->second));
  streams_.erase(found);
  last_active_ = loop().now();
  return 0;
}

int Connection::OnFrameSent(const nghttp2_frame& frame) {
  const bool is_answer = frame.hd.type == NGHTTP2_DATA || frame.hd.type == NGHTTP2_HEADERS;
  if (!is_answer) return 0;
  control_frames_.Earn();
  if ((frame.hd.flags & NGHTTP2_FLAG_END_STREAM) == 0) return 0;
  // RFC 9113, section 8.1: after a complete answer, the rest of the request is not needed.
  const GrpcStream* stream = FindStream(frame.hd.stream_id);
  if (stream != nullptr && stream->request_state() == GrpcStream::RequestState::kOpen) {
    nghttp2_submit_rst_stream(session_.get(), NGHTTP2_FLAG_NONE, frame.hd.stream_id,
                              NGHTTP2_NO_ERROR);
  }
  return 0;
}

}  // namespace spikeserve
