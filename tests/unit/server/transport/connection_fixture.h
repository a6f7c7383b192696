// A connection without a network: the bytes of its socket are strings, and the client is a session
// of nghttp2 in the same thread.
//
//   const int32_t id = client_.Open({{":path", "/service/method"}});
//   Exchange();
//   EXPECT_EQ(connection_->state(), Connection::State::kOpen);
#pragma once

#include <gtest/gtest.h>
#include <nghttp2/nghttp2.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>

#include <algorithm>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "server/transport/connection.h"
#include "server/transport/grpc_stream.h"
#include "tests/support/fake_clock.h"

namespace spikeserve {

// What is on its way between the client and the server.
struct Wire {
  std::string to_server;
  std::string to_client;
  bool client_left = false;
  bool server_shut_down = false;
  bool takes_bytes = true;  // of the server
  bool is_handshaking = false;
};

// The server's end of a wire. `wire` must outlive the socket.
class WireSocket final : public Socket {
 public:
  explicit WireSocket(Wire* wire) : fd_(eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK)), wire_(*wire) {}

  int fd() const override { return fd_.get(); }
  bool is_handshaking() const override { return wire_.is_handshaking; }
  void ShutDownWriting() override { wire_.server_shut_down = true; }

  Result Read(absl::Span<char> buffer) override {
    if (wire_.to_server.empty()) {
      return {wire_.client_left ? Outcome::kClosed : Outcome::kBlocked};
    }
    const size_t count = wire_.to_server.copy(buffer.data(), buffer.size());
    wire_.to_server.erase(0, count);
    return {Outcome::kDone, count};
  }

  Result Write(absl::string_view data) override {
    EXPECT_FALSE(wire_.server_shut_down);
    if (!wire_.takes_bytes) return {Outcome::kBlocked};
    wire_.to_client.append(data.data(), data.size());
    return {Outcome::kDone, data.size()};
  }

 private:
  const FileDescriptor fd_;  // to be watched
  Wire& wire_;
};

// An HTTP/2 client, which remembers what it receives.
class WireClient {
 public:
  using Headers = std::vector<std::pair<std::string, std::string>>;
  struct Answer {
    std::map<std::string, std::string> headers;  // and trailers
    std::string data;
    bool has_ended = false;
  };

  WireClient() {
    nghttp2_session_callbacks* callbacks = nullptr;
    nghttp2_session_callbacks_new(&callbacks);
    nghttp2_session_callbacks_set_on_header_callback(callbacks, &OnHeader);
    nghttp2_session_callbacks_set_on_data_chunk_recv_callback(callbacks, &OnData);
    nghttp2_session_callbacks_set_on_frame_recv_callback(callbacks, &OnFrame);
    nghttp2_session* session = nullptr;
    nghttp2_session_client_new(&session, callbacks, this);
    nghttp2_session_callbacks_del(callbacks);
    session_.reset(session);
    nghttp2_submit_settings(session, NGHTTP2_FLAG_NONE, nullptr, 0);
  }

  // Starts a request, a gRPC call unless `changed` says otherwise. Returns the stream's number.
  int32_t Open(const Headers& changed = {}) {
    std::map<std::string, std::string> headers = {{":authority", "server"},
                                                  {":method", "POST"},
                                                  {":scheme", "http"},
                                                  {":path", "/service/method"},
                                                  {"content-type", "application/grpc"}};
    for (const auto& [name, value] : changed) headers[name] = value;
    std::vector<nghttp2_nv> fields;  // the names that begin with a colon sort first
    for (const auto& [name, value] : headers) {
      fields.push_back({.name = Bytes(name),
                        .value = Bytes(value),
                        .namelen = name.size(),
                        .valuelen = value.size(),
                        .flags = NGHTTP2_NV_FLAG_NONE});
    }
    return nghttp2_submit_headers(session(), NGHTTP2_FLAG_NONE, -1, nullptr, fields.data(),
                                  fields.size(), nullptr);
  }

  // Sends `data`, and END_STREAM if `is_last`. Call Exchange() before the next one.
  void Send(int32_t id, std::string data, bool is_last) {
    data_[id] = std::move(data);
    nghttp2_data_provider provider = {.source = {.ptr = &data_[id]}, .read_callback = &Read};
    nghttp2_submit_data(session(), is_last ? NGHTTP2_FLAG_END_STREAM : NGHTTP2_FLAG_NONE, id,
                        &provider);
  }

  nghttp2_session* session() { return session_.get(); }
  Answer& answer(int32_t id) { return answers_[id]; }
  // Returns the error of each GOAWAY.
  const std::vector<uint32_t>& goaways() const { return goaways_; }

 private:
  struct FreeSession {
    void operator()(nghttp2_session* session) const { nghttp2_session_del(session); }
  };

  static uint8_t* Bytes(const std::string& text) {
    return reinterpret_cast<uint8_t*>(const_cast<char*>(text.data()));
  }
  static std::string Text(const uint8_t* bytes, size_t size) {
    return {reinterpret_cast<const char*>(bytes), size};
  }
  static WireClient* Self(void* self) { return static_cast<WireClient*>(self); }

  static ssize_t Read(nghttp2_session* /*session*/, int32_t /*id*/, uint8_t* out, size_t size,
                      uint32_t* flags, nghttp2_data_source* source, void* /*self*/) {
    auto* const data = static_cast<std::string*>(source->ptr);
    const size_t count = data->copy(reinterpret_cast<char*>(out), size);
    data->erase(0, count);
    if (data->empty()) *flags |= NGHTTP2_DATA_FLAG_EOF;
    return static_cast<ssize_t>(count);
  }
  static int OnHeader(nghttp2_session* /*session*/, const nghttp2_frame* frame, const uint8_t* name,
                      size_t name_size, const uint8_t* value, size_t value_size, uint8_t /*flags*/,
                      void* self) {
    Self(self)->answers_[frame->hd.stream_id].headers[Text(name, name_size)] =
        Text(value, value_size);
    return 0;
  }
  static int OnData(nghttp2_session* /*session*/, uint8_t /*flags*/, int32_t id,
                    const uint8_t* data, size_t size, void* self) {
    Self(self)->answers_[id].data += Text(data, size);
    return 0;
  }
  static int OnFrame(nghttp2_session* /*session*/, const nghttp2_frame* frame, void* self) {
    const bool may_end = frame->hd.type == NGHTTP2_HEADERS || frame->hd.type == NGHTTP2_DATA;
    if (may_end && (frame->hd.flags & NGHTTP2_FLAG_END_STREAM) != 0) {
      Self(self)->answers_[frame->hd.stream_id].has_ended = true;
    }
    if (frame->hd.type == NGHTTP2_GOAWAY) {
      Self(self)->goaways_.push_back(frame->goaway.error_code);
    }
    return 0;
  }

  std::unique_ptr<nghttp2_session, FreeSession> session_;
  std::map<int32_t, std::string> data_;  // to be sent
  std::map<int32_t, Answer> answers_;
  std::vector<uint32_t> goaways_;
};

// Records what happens to a call.
class RecordingHandler final : public CallHandler {
 public:
  explicit RecordingHandler(Call* call) : stream_(static_cast<GrpcStream*>(call)) {}

  size_t message_limit() const override { return 1000; }
  void OnMessage(absl::string_view message) override {
    events_.push_back(std::string(message));
    if (pauses_) stream_->PauseReading();
  }
  void OnTooLong(size_t /*length*/) override { events_.push_back("too long"); }
  void OnHalfClose() override { events_.push_back("half close"); }
  void OnClosed() override {
    closed_as_ = stream_->answer_state();
    stream_ = nullptr;
  }
  void OnDrain() override { events_.push_back("drain"); }

  // Pauses reading after each message from now on.
  void Pause() { pauses_ = true; }
  // Returns the stream; null: it is closed.
  GrpcStream* stream() { return stream_; }
  const std::vector<std::string>& events() const { return events_; }
  // Returns the state in which OnClosed() was called.
  std::optional<GrpcStream::AnswerState> closed_as() const { return closed_as_; }

 private:
  GrpcStream* stream_;
  bool pauses_ = false;
  std::vector<std::string> events_;
  std::optional<GrpcStream::AnswerState> closed_as_;
};

class ConnectionFixture : public testing::Test, protected CallRouter, private ConnectionCloser {
 protected:
  ConnectionFixture()
      : loop_(*EventLoop::Create(&clock_)),
        shared_({.loop = loop_.get(),
                 .clock = &clock_,
                 .router = this,
                 .limits = &limits_,
                 .budgets = &budgets_,
                 .closed = [this](Connection*) { ++times_closed_; },
                 .unauthenticated_queue = UnauthenticatedQueue(loop_.get(), &clock_)}) {
    limits_.max_control_frames_per_second = 10;
    const ClientOrigin origin = {
        .address = "192.0.2.1", .host = "192.0.2.1", .network = "192.0.2.0/24"};
    connection_ = std::make_unique<Connection>(std::make_unique<WireSocket>(&wire_),
                                               table_.Admit(origin, this), &shared_);
    EXPECT_TRUE(connection_->Start().ok());
  }
  ~ConnectionFixture() override {
    connection_->Close();
    EXPECT_EQ(times_closed_, 1);
    for (const auto& handler : handlers_) EXPECT_TRUE(handler->closed_as().has_value());
  }

  // Lets the server read what the client has sent, and answer.
  void Serve() {
    connection_->OnReady(EPOLLIN);
    for (Connection* waiting : std::exchange(shared_.to_flush, {})) waiting->Flush();
  }
  // Carries bytes in both directions until there are none.
  void Exchange() {
    do {
      const uint8_t* bytes = nullptr;
      while (true) {
        const ssize_t size = nghttp2_session_mem_send(client_.session(), &bytes);
        if (size <= 0) break;
        wire_.to_server.append(reinterpret_cast<const char*>(bytes), static_cast<size_t>(size));
      }
      Serve();
      const std::string answer = std::exchange(wire_.to_client, {});
      nghttp2_session_mem_recv(client_.session(), reinterpret_cast<const uint8_t*>(answer.data()),
                               answer.size());
    } while (nghttp2_session_want_write(client_.session()) != 0 || !wire_.to_client.empty());
  }
  // Opens a call, and returns its handler once the server has it.
  RecordingHandler& OpenCall(const WireClient::Headers& changed = {}) {
    last_id_ = client_.Open(changed);
    Exchange();
    return *handlers_.back();
  }
  // Does each part of `work` in a turn of the loop of its own, because the loop reads the clock
  // when a turn starts. May be called once.
  void InTurns(std::vector<std::function<void()>> work) {
    std::reverse(work.begin(), work.end());
    std::function<void()> next = [&] {
      if (work.empty()) return loop_->Stop();
      const auto part = std::move(work.back());
      work.pop_back();
      part();
      loop_->Post(next);
    };
    loop_->Post(next);
    loop_->Run();
  }
  WireClient::Answer& last_answer() { return client_.answer(last_id_); }

  FakeClock clock_;
  Wire wire_;
  WireClient client_;
  TransportLimits limits_;
  TransportBudgets budgets_;
  ConnectionTable table_{
      {.connections = 1, .per_address = 1, .per_network = 1, .idle_unauthenticated = 1}};
  const std::unique_ptr<EventLoop> loop_;
  Connection::Shared shared_;
  std::vector<std::shared_ptr<RecordingHandler>> handlers_;
  int32_t last_id_ = 0;  // of the stream of OpenCall()
  int times_closed_ = 0;
  std::unique_ptr<Connection> connection_;

 private:
  // CallRouter
  std::shared_ptr<CallHandler> Route(Call* call) override {
    handlers_.push_back(std::make_shared<RecordingHandler>(call));
    return handlers_.back();
  }
  // ConnectionCloser
  void CloseSoon(uint64_t /*number*/) override {}
};

}  // namespace spikeserve
