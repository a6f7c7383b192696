#include "server/access/certificate_watch.h"

#include <utility>

#include "absl/time/clock.h"
#include "core/contract/dcheck.h"
#include "server/base/log.h"

namespace spikeserve {
namespace {

constexpr absl::Duration kInterval = absl::Seconds(2);

std::string Text(absl::Time time) { return absl::FormatTime(time, absl::UTCTimeZone()); }

}  // namespace

void CertificateWatch::Start() {
  SPIKESERVE_DCHECK(is_used());
  CheckValidity();
  periodic_ = std::make_unique<Periodic>(kInterval, [this] { Check(); });
}

void CertificateWatch::Check() {
  std::string error;
  bool changed = false;
  for (TlsContext* context : contexts_) {
    const auto loaded = context->Reload();
    if (loaded.ok()) {
      changed = changed || *loaded;
    } else {
      error = std::string(loaded.status().message());
    }
  }
  fails_.store(!error.empty(), std::memory_order_relaxed);
  if (!error.empty() && error != last_error_) {
    LogError("certificate not reloaded; the old one stays in use", {{"error", error}});
  }
  last_error_ = error;
  if (changed && error.empty()) LogInfo("certificate reloaded", {{"expires", Text(times().end)}});
  CheckValidity();
}

void CertificateWatch::CheckValidity() {
  const CertificateTimes now_used = times();
  const absl::Time now = absl::Now();
  const bool is_valid = now_used.valid_at(now) && now < now_used.client_ca;
  if (is_valid || std::exchange(reported_end_, now_used.end) == now_used.end) return;
  if (!now_used.valid_at(now)) {
    LogError("certificate not valid; clients will refuse it",
             {{"valid_from", Text(now_used.begin)}, {"expires", Text(now_used.end)}});
  } else {
    LogError("authority of the clients has expired; their certificates are refused",
             {{"expired", Text(now_used.client_ca)}});
  }
}

}  // namespace spikeserve
