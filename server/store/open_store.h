// Opens the store that --session_store names.
//
// A free function without shared state; safe to call from many threads.
#pragma once

#include <memory>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "prometheus/registry.h"
#include "server/heads/head_log_store.h"
#include "server/store/file_backend.h"
#include "server/store/journal_store.h"
#include "server/store/redis_shared.h"
#include "server/store/store_options.h"

namespace spikeserve {

// The parts of a store, with the address and the name of this server that /status.json shows.
struct OpenedStore {
  std::string address = "memory";                    // without a password
  std::string replica = "";                          // identifies this server; empty for memory
  std::unique_ptr<JournalStore> journals = nullptr;  // null: no session is stored
  std::unique_ptr<RedisShared> shared = nullptr;     // null: this server shares nothing
  std::unique_ptr<HeadLogStore> heads = nullptr;     // null as `shared`
};

// Opens the store. Returns INVALID_ARGUMENT if a file store cannot be
// used. A Redis server that cannot be reached is no error: the store tries again. `registry` must
// outlive the store. `visitor` reads the journals of a file store first.
absl::StatusOr<OpenedStore> OpenStore(const StoreOptions& options, prometheus::Registry* registry,
                                      const JournalVisitor& visitor = {});

// Returns how the Redis that --session_store names is reached; nullopt: it names none.
// INVALID_ARGUMENT, which names the flag.
absl::StatusOr<std::optional<RedisOptions>> RedisOptionsOf(const StoreOptions& options);

}  // namespace spikeserve
