// Opens sessions: new ones, and again those that the same request has opened.
//
// Thread-safe.
#pragma once

#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/agent/episode_recorder.h"
#include "core/base/clock.h"
#include "core/journal/journal_writer.h"
#include "core/open_sessions/session_store.h"
#include "server/access/authenticator.h"
#include "server/agent/call_context.h"
#include "server/agent/datagram_channels.h"
#include "server/agent/session_gate.h"
#include "server/followers/recordings.h"
#include "server/policies/policy_registry.h"
#include "server/policies/shared_files.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// How sessions are stored.
struct SessionDurability {
  JournalWriter* journals = nullptr;      // null: no session is stored
  Durability level = Durability::kAsync;  // of sessions that ask for none and do not learn
  const SharedFiles* files = nullptr;     // null: no other server continues with them
};

class SessionOpener {
 public:
  // The pointers must outlive the object. If `recordings` is null, sessions cannot be recorded; if
  // `datagrams` is, they get no channel for datagrams.
  SessionOpener(const PolicyRegistry* registry, const SessionGate* gate, const Clock* clock,
                Recordings* recordings, SessionDurability durability, DatagramChannels* datagrams)
      : registry_(registry),
        gate_(gate),
        clock_(clock),
        recordings_(recordings),
        durability_(durability),
        datagrams_(datagrams) {}

  // As the methods of PolicyHandler.
  absl::Status Open(CallContext& context, const v1::OpenSessionRequest& request,
                    v1::OpenSessionResponse* response) const;
  absl::Status OpenAs(CallContext& context, std::string id, const v1::OpenSessionRequest& request,
                      v1::OpenSessionResponse* response) const;

 private:
  // Returns the durability of a new session: INVALID_ARGUMENT if the server cannot give it,
  // PERMISSION_DENIED if it is above the ceiling of the tenant.
  absl::StatusOr<Durability> ChooseDurability(const Tenant& tenant,
                                              const v1::OpenSessionRequest& request) const;
  // Returns the settings of a session that `request` opens.
  absl::StatusOr<SessionOptions> OptionsOf(const v1::OpenSessionRequest& request,
                                           const ServedPolicy& served) const;
  // Opens a session that does not exist yet.
  absl::Status OpenNew(CallContext& context, std::string id, const v1::OpenSessionRequest& request,
                       Durability durability, v1::OpenSessionResponse* response) const;
  // Answers a request for a session that is open. Returns ALREADY_EXISTS unless the same request
  // opened it.
  absl::Status OpenAgain(CallContext& context, SessionEntry& entry,
                         const v1::OpenSessionRequest& request, Durability durability,
                         v1::OpenSessionResponse* response) const;

  // Returns a recorder for a session of `served`, and sets `name` to a new name for the recording.
  absl::StatusOr<std::unique_ptr<EpisodeRecorder>> NewRecorder(
      const std::shared_ptr<const ServedPolicy>& served, const std::string& tenant,
      std::string* name) const;

  const PolicyRegistry* const registry_;
  const SessionGate* const gate_;
  const Clock* const clock_;
  Recordings* const recordings_;
  const SessionDurability durability_;
  DatagramChannels* const datagrams_;  // null: the server offers none
};

}  // namespace spikeserve
