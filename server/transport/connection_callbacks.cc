// How nghttp2 calls a Connection, which is the user data of its session.
#include <nghttp2/nghttp2.h>

#include <cstddef>
#include <cstdint>

#include "absl/strings/string_view.h"
#include "server/transport/connection.h"

namespace spikeserve {
namespace {

absl::string_view View(const uint8_t* data, size_t size) {
  return {reinterpret_cast<const char*>(data), size};
}

Connection* Self(void* user_data) { return static_cast<Connection*>(user_data); }

}  // namespace

const nghttp2_session_callbacks* Connection::Callbacks() {
  static const nghttp2_session_callbacks* const callbacks = [] {
    nghttp2_session_callbacks* made = nullptr;
    nghttp2_session_callbacks_new(&made);
    nghttp2_session_callbacks_set_on_begin_headers_callback(
        made, [](nghttp2_session* /*session*/, const nghttp2_frame* frame, void* self) {
          if (frame->headers.cat != NGHTTP2_HCAT_REQUEST) return 0;
          return Self(self)->OnBeginHeaders(frame->hd.stream_id);
        });
    nghttp2_session_callbacks_set_on_header_callback(
        made, [](nghttp2_session* /*session*/, const nghttp2_frame* frame, const uint8_t* name,
                 size_t name_size, const uint8_t* value, size_t value_size, uint8_t /*flags*/,
                 void* self) {
          return Self(self)->OnHeader(frame->hd.stream_id, View(name, name_size),
                                      View(value, value_size));
        });
    nghttp2_session_callbacks_set_on_begin_frame_callback(
        made, [](nghttp2_session* /*session*/, const nghttp2_frame_hd* header, void* self) {
          if (header->type == NGHTTP2_HEADERS) {
            Self(self)->headers_since_ = Self(self)->loop().now();
          }
          return 0;
        });
    nghttp2_session_callbacks_set_on_frame_recv_callback(
        made, [](nghttp2_session* /*session*/, const nghttp2_frame* frame, void* self) {
          return Self(self)->OnFrame(*frame);
        });
    nghttp2_session_callbacks_set_on_data_chunk_recv_callback(
        made,
        [](nghttp2_session* /*session*/, uint8_t /*flags*/, int32_t id, const uint8_t* data,
           size_t size, void* self) { return Self(self)->OnDataChunk(id, View(data, size)); });
    nghttp2_session_callbacks_set_on_stream_close_callback(
        made, [](nghttp2_session* /*session*/, int32_t id, uint32_t /*error*/, void* self) {
          return Self(self)->OnStreamClosed(id);
        });
    nghttp2_session_callbacks_set_on_frame_send_callback(
        made, [](nghttp2_session* /*session*/, const nghttp2_frame* frame, void* self) {
          return Self(self)->OnFrameSent(*frame);
        });
    nghttp2_session_callbacks_set_on_invalid_frame_recv_callback(
        made, [](nghttp2_session* /*session*/, const nghttp2_frame* /*frame*/, int /*error*/,
                 void* self) { return Self(self)->OnInvalidFrame(); });
    return made;
  }();
  return callbacks;
}

const nghttp2_option* Connection::SessionOption() {
  static const nghttp2_option* const option = [] {
    nghttp2_option* made = nullptr;
    nghttp2_option_new(&made);
    nghttp2_option_set_no_auto_window_update(made, 1);
    return made;
  }();
  return option;
}

}  // namespace spikeserve
