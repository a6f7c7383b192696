#include "server/transport/connection_callbacks.h"

#include "absl/strings/string_view.h"

namespace spikeserve {
namespace {

absl::string_view View(const uint8_t* data, size_t size) {
  return {reinterpret_cast<const char*>(data), size};
}

}  // namespace

const nghttp2_session_callbacks* ConnectionCallbacks::Get() {
  static const nghttp2_session_callbacks* const callbacks = Make();
  return callbacks;
}

const nghttp2_option* ConnectionCallbacks::GetOption() {
  static const nghttp2_option* const option = MakeOption();
  return option;
}

Connection* ConnectionCallbacks::Self(void* user_data) {
  return static_cast<Connection*>(user_data);
}

int ConnectionCallbacks::OnBeginHeaders(nghttp2_session* /*session*/, const nghttp2_frame* frame,
                                        void* user) {
  if (frame->headers.cat != NGHTTP2_HCAT_REQUEST) return 0;
  return Self(user)->OnBeginHeaders(frame->hd.stream_id);
}

int ConnectionCallbacks::OnHeader(nghttp2_session* /*session*/, const nghttp2_frame* frame,
                                  const uint8_t* name, size_t name_size, const uint8_t* value,
                                  size_t value_size, uint8_t /*flags*/, void* user) {
  return Self(user)->OnHeader(frame->hd.stream_id, View(name, name_size), View(value, value_size));
}

int ConnectionCallbacks::OnBeginFrame(nghttp2_session* /*session*/, const nghttp2_frame_hd* header,
                                      void* user) {
  if (header->type == NGHTTP2_HEADERS) {
    Self(user)->headers_since_ = Self(user)->loop().now();
  }
  return 0;
}

int ConnectionCallbacks::OnFrame(nghttp2_session* /*session*/, const nghttp2_frame* frame,
                                 void* user) {
  return Self(user)->OnFrame(*frame);
}

int ConnectionCallbacks::OnDataChunk(nghttp2_session* /*session*/, uint8_t /*flags*/, int32_t id,
                                     const uint8_t* data, size_t size, void* user) {
  return Self(user)->OnDataChunk(id, View(data, size));
}

int ConnectionCallbacks::OnStreamClose(nghttp2_session* /*session*/, int32_t id, uint32_t /*error*/,
                                       void* user) {
  return Self(user)->OnStreamClosed(id);
}

int ConnectionCallbacks::OnFrameSend(nghttp2_session* /*session*/, const nghttp2_frame* frame,
                                     void* user) {
  return Self(user)->OnFrameSent(*frame);
}

int ConnectionCallbacks::OnInvalidFrame(nghttp2_session* /*session*/,
                                        const nghttp2_frame* /*frame*/, int /*error*/, void* user) {
  return Self(user)->OnInvalidFrame();
}

nghttp2_session_callbacks* ConnectionCallbacks::Make() {
  nghttp2_session_callbacks* callbacks = nullptr;
  nghttp2_session_callbacks_new(&callbacks);
  nghttp2_session_callbacks_set_on_begin_headers_callback(callbacks, &OnBeginHeaders);
  nghttp2_session_callbacks_set_on_header_callback(callbacks, &OnHeader);
  nghttp2_session_callbacks_set_on_begin_frame_callback(callbacks, &OnBeginFrame);
  nghttp2_session_callbacks_set_on_frame_recv_callback(callbacks, &OnFrame);
  nghttp2_session_callbacks_set_on_data_chunk_recv_callback(callbacks, &OnDataChunk);
  nghttp2_session_callbacks_set_on_stream_close_callback(callbacks, &OnStreamClose);
  nghttp2_session_callbacks_set_on_frame_send_callback(callbacks, &OnFrameSend);
  nghttp2_session_callbacks_set_on_invalid_frame_recv_callback(callbacks, &OnInvalidFrame);
  return callbacks;
}

nghttp2_option* ConnectionCallbacks::MakeOption() {
  nghttp2_option* option = nullptr;
  nghttp2_option_new(&option);
  nghttp2_option_set_no_auto_window_update(option, 1);
  return option;
}

}  // namespace spikeserve
