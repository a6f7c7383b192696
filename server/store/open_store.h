// Opens the store that --session_store names.
//
// A free function without shared state; safe to call from many threads.
#ifndef SERVER_STORE_OPEN_STORE_H_
#define SERVER_STORE_OPEN_STORE_H_

#include <memory>

#include "absl/status/statusor.h"
#include "prometheus/registry.h"
#include "server/store/journal_store.h"
#include "server/store/store_options.h"

namespace spikeserve {

// Opens the store. Returns null for memory. Returns INVALID_ARGUMENT if a file store cannot be
// used. A Redis server that cannot be reached is no error: the store tries again. `registry` must
// outlive the store.
absl::StatusOr<std::unique_ptr<JournalStore>> OpenStore(const StoreOptions& options,
                                                        prometheus::Registry* registry);

}  // namespace spikeserve

#endif  // SERVER_STORE_OPEN_STORE_H_
