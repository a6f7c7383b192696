// Passes the callbacks of nghttp2 on to a Connection, which is their user data.
//
// Thread-safe.
#pragma once

#include <nghttp2/nghttp2.h>

#include <cstddef>
#include <cstdint>

#include "server/transport/connection.h"

namespace spikeserve {

// What every session of the process uses; lives as long as the process.
struct ConnectionCallbacks {
  static const nghttp2_session_callbacks* Get();
  static const nghttp2_option* GetOption();

 private:
  static Connection* Self(void* user_data);
  static int OnBeginHeaders(nghttp2_session* session, const nghttp2_frame* frame, void* user);
  static int OnHeader(nghttp2_session* session, const nghttp2_frame* frame, const uint8_t* name,
                      size_t name_size, const uint8_t* value, size_t value_size, uint8_t flags,
                      void* user);
  static int OnBeginFrame(nghttp2_session* session, const nghttp2_frame_hd* header, void* user);
  static int OnFrame(nghttp2_session* session, const nghttp2_frame* frame, void* user);
  static int OnDataChunk(nghttp2_session* session, uint8_t flags, int32_t id, const uint8_t* data,
                         size_t size, void* user);
  static int OnStreamClose(nghttp2_session* session, int32_t id, uint32_t error, void* user);
  static int OnFrameSend(nghttp2_session* session, const nghttp2_frame* frame, void* user);
  static int OnInvalidFrame(nghttp2_session* session, const nghttp2_frame* frame, int error,
                            void* user);
  static nghttp2_session_callbacks* Make();
  static nghttp2_option* MakeOption();
};

}  // namespace spikeserve
