// Traces records that no answer waits for on their way into the store.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_AGENT_TRACE_RECORD_H_
#define SERVER_AGENT_TRACE_RECORD_H_

#include <memory>

#include "core/session/head_log.h"
#include "core/session/session_store.h"
#include "server/trace/span.h"

namespace spikeserve {

// Begins a span "append" of `call`, which ends when the store has what was written to the journal
// of the session; and then, for a contribution, a span "merge", which ends when the head of the
// fleet has it. A record that is traced does not gather with others before it is written. Call it
// under the session's lock. Does nothing if `call` is empty or the session is not stored.
void TraceRecord(const Span& call, const SessionEntry& entry,
                 const std::shared_ptr<FleetContribution>& contribution = nullptr);

}  // namespace spikeserve

#endif  // SERVER_AGENT_TRACE_RECORD_H_
