// One connection of HTTP/1.1, which carries one request.
//
// Confined to the thread of its loop.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <variant>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "server/access/tls_context.h"
#include "server/base/address.h"
#include "server/transport/connection_table.h"
#include "server/transport/event_loop.h"
#include "server/transport/socket.h"
#include "server/web/http_message.h"
#include "server/web/origins.h"

namespace spikeserve {

// Admits the caller of a POST before any of its body is read, or returns the answer to a POST that
// is refused. Called on the loop's thread.
using AcceptHttpBody =
    std::function<std::variant<AcceptedBody, HttpResponse>(const HttpRequest& request)>;

struct HttpOptions {
  Address listen;
  TlsContext* tls = nullptr;        // null: plain text; must outlive the server
  bool local_names_only = false;    // answers 403 unless the header Host names this machine
  bool has_tokens = false;          // callers are known by tokens, which other sites do not have
  Origins origins = {};             // whose pages may send a POST, and read answers
  const Clock* clock = nullptr;     // monotonic; must outlive the server
  AcceptHttpBody accept_body = {};  // empty: every POST is answered with 405
};

// The client has five seconds for the headers of its request, a TLS handshake included, thirty for
// the body of a POST, and thirty to take the answer, however it divides the bytes. A request has at
// most 16 KiB of headers; the body of a GET is not read. A body is passed on as it came, compressed
// or not. A body that goes on (HttpFeed) ends when
// its feed does, when the client leaves, or when it takes nothing for thirty seconds.
class HttpConnection final : public EventLoop::Source {
 public:
  // Who owns the connection.
  class Owner {
   public:
    virtual EventLoop& events() = 0;
    // See AcceptHttpBody.
    virtual std::variant<AcceptedBody, HttpResponse> AcceptBody(const HttpRequest& request) = 0;
    // Computes the answer to a request, and calls Answer() of the connection later.
    virtual void OnRequest(HttpConnection* connection, HttpRequest request) = 0;
    // Destroys the connection at the end of the turn.
    virtual void OnClosed(HttpConnection* connection) = 0;

   protected:
    ~Owner() = default;
  };

  // `options`, those of the server, and `owner` must outlive the connection. REQUIRES: Close() is
  // called before the destructor.
  HttpConnection(std::unique_ptr<Socket> socket, std::unique_ptr<ConnectionSlot> slot,
                 const HttpOptions& options, Owner* owner);
  ~HttpConnection() override;

  // Watches the socket. Returns RESOURCE_EXHAUSTED if the system has no memory for that.
  absl::Status Start();
  // Sends the answer to the request and closes the connection in order.
  void Answer(HttpResponse response);
  // Closes the connection now.
  void Close();
  // Ends a body that goes on. Does nothing to other connections.
  void EndFeed();

  // EventLoop::Source
  void OnReady(uint32_t events) override;

  // Returns the connection's number in the table.
  uint64_t number() const { return slot_->number(); }

 private:
  enum class State {
    kReading,
    kReadingBody,
    kAnswering,
    kDelaying,
    kWriting,
    kFeeding,
    kClosing,
    kClosed
  };
  struct Parser;  // of the library

  void Read();
  // Parses what was received. Calls the owner, or answers an invalid request.
  void Parse();
  void ParseHeaders();
  // Copies the headers of the request that pages need.
  void StoreHeaders();
  // Returns whether the page that sends a POST may: it is of this server, or of `origins`.
  bool MaySend() const;
  // Reads the body of a POST, if it is accepted.
  void StartBody();
  // Returns why the form of the body is refused, or a response without a code.
  HttpResponse CheckBodyHeaders();
  // Takes what has arrived of the body.
  void TakeBody();
  // Acts on the end of the time that the connection may stay in its state.
  void OnTimeout();
  // Passes `request_` on to the owner.
  void Submit();
  void Write();
  // Waits until the feed is to be asked again, or the client leaves.
  void WaitForFeed();
  // Sends what the feed has.
  void Feed();
  // Reads and drops what arrives, so that the client can read the answer before the system resets
  // the connection for unread bytes.
  void DropInput();
  // Goes to `state`, in which the connection stays for at most `timeout`, and waits for `events`.
  void Enter(State state, absl::Duration timeout, uint32_t events);
  EventLoop& events() { return owner_->events(); }

  const std::shared_ptr<const void> client_ = std::make_shared<char>();  // see HttpRequest
  const std::unique_ptr<Socket> socket_;
  const std::unique_ptr<ConnectionSlot> slot_;
  const HttpOptions& options_;
  Owner* const owner_;
  std::unique_ptr<Parser> parser_;
  State state_ = State::kReading;
  EventLoop::Timer timer_;
  std::string input_;  // received and not yet parsed
  HttpRequest request_;
  std::string origin_headers_;      // of the answer, for the page that sent the request
  std::shared_ptr<HttpFeed> feed_;  // null: nothing follows `output_`
  std::string output_;
  std::string body_;    // follows `output_`
  size_t written_ = 0;  // bytes of `output_`
  size_t dropped_ = 0;  // bytes
  bool is_head_ = false;
};

}  // namespace spikeserve
