// Reads the certificates of all ports again while the server runs, and shows what is wrong with
// them: in the log when it changes, and in metrics.
//
// Thread-safe, except Add() and Start().
#pragma once

#include <atomic>
#include <memory>
#include <string>
#include <vector>

#include "absl/time/time.h"
#include "server/access/tls_context.h"
#include "server/base/periodic.h"

namespace spikeserve {

class CertificateWatch {
 public:
  // Watches `context`, which must outlive this object. All contexts have the same files.
  void Add(TlsContext* context) { contexts_.push_back(context); }

  // Logs the state of the certificate, and looks at the files every two seconds from now on.
  // REQUIRES: a context was added.
  void Start();

  // Returns true if the files were changed and cannot be used.
  bool fails() const { return fails_.load(std::memory_order_relaxed); }
  // REQUIRES: a context was added.
  CertificateTimes times() const { return contexts_.front()->times(); }
  bool is_used() const { return !contexts_.empty(); }

 private:
  void Check();
  // Logs that the certificate in use is not valid, once.
  void CheckValidity();

  std::vector<TlsContext*> contexts_;
  std::atomic<bool> fails_ = false;
  std::string last_error_;  // that was logged; of the watching thread
  absl::Time reported_end_ =
      absl::InfinitePast();             // of the certificate that was reported; as above
  std::unique_ptr<Periodic> periodic_;  // last, because its thread uses the others
};

}  // namespace spikeserve
