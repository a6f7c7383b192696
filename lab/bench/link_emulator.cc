// A link between two network namespaces, with delay and loss: a TUN device in each, and this
// process between them, for kernels without netem. Needs root.
//
//   link_emulator PID PID
//
// makes the device "link" in the namespaces of two processes, prints "ready", and does what the
// lines of its standard input say, until its end:
//
//   set DELAY LOSS BURST   seconds in each direction, share of lost packets, and how many of them
//                    follow each other on average (Gilbert's model); 0: each one is lost by itself
//   cut              drops everything
//   heal             ends cut
//   forget           drops the packets of the connections that it has seen, as a NAT that has
//                    forgotten them
//
// Single-threaded. The same order of packets loses the same ones.
#include <fcntl.h>
#include <linux/if.h>
#include <linux/if_tun.h>
#include <poll.h>
#include <sched.h>
#include <sys/ioctl.h>
#include <sys/prctl.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <iostream>
#include <random>
#include <set>
#include <sstream>
#include <string>
#include <vector>

namespace {

using Clock = std::chrono::steady_clock;

constexpr size_t kLargestPacket = 65536;
constexpr size_t kQueue = 20'000;  // packets in one direction; more are dropped

[[noreturn]] void Fail(const std::string& what) {
  std::perror(what.c_str());
  std::exit(1);
}

// Returns the descriptor of the TUN device "link" in the namespace of a process.
int OpenTun(const std::string& pid) {
  const int space = open(("/proc/" + pid + "/ns/net").c_str(), O_RDONLY | O_CLOEXEC);
  if (space < 0 || setns(space, CLONE_NEWNET) != 0) Fail("namespace of process " + pid);
  close(space);
  const int tun = open("/dev/net/tun", O_RDWR | O_NONBLOCK | O_CLOEXEC);
  if (tun < 0) Fail("/dev/net/tun");
  ifreq request = {};
  request.ifr_flags = IFF_TUN | IFF_NO_PI;
  std::strcpy(request.ifr_name, "link");
  if (ioctl(tun, TUNSETIFF, &request) != 0) Fail("TUNSETIFF");
  return tun;
}

// Returns what names the connection of a TCP packet of IPv4 in both directions; 0: another packet.
uint32_t ConnectionOf(const std::vector<char>& packet) {
  const auto byte = [&](size_t i) {
    return static_cast<uint32_t>(static_cast<uint8_t>(packet[i]));
  };
  if (packet.size() < 40 || byte(0) >> 4 != 4 || byte(9) != 6) return 0;
  const size_t ports = 4 * (byte(0) & 15);
  if (packet.size() < ports + 4) return 0;
  const uint32_t from = byte(ports) << 8 | byte(ports + 1);
  const uint32_t to = byte(ports + 2) << 8 | byte(ports + 3);
  return std::min(from, to) << 16 | std::max(from, to);
}

struct Packet {
  Clock::time_point due;
  std::vector<char> bytes;
};

class Link {
 public:
  void Do(const std::string& line) {
    std::istringstream words(line);
    std::string what;
    words >> what;
    if (what == "set") {
      double seconds = 0.0;
      words >> seconds >> loss_ >> burst_;
      delay_ = std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(seconds));
    }
    if (what == "cut" || what == "heal") is_cut_ = what == "cut";
    if (what == "forget") forgotten_ = seen_;
  }

  // Reads the packets that wait at `tun`, and queues those that are not lost.
  void Read(int tun, int side, std::deque<Packet>& queue) {
    while (true) {
      buffer_.resize(kLargestPacket);
      const ssize_t size = read(tun, buffer_.data(), buffer_.size());
      if (size <= 0) return;
      buffer_.resize(static_cast<size_t>(size));
      const uint32_t connection = ConnectionOf(buffer_);
      if (connection != 0) seen_.insert(connection);
      const bool is_lost = Loses(side);
      if (is_cut_ || is_lost || forgotten_.contains(connection) || queue.size() >= kQueue) continue;
      queue.push_back({.due = Clock::now() + delay_, .bytes = buffer_});
    }
  }

  // Writes the packets of `queue` that are due to `tun`.
  static void Write(int tun, std::deque<Packet>& queue) {
    for (; !queue.empty() && queue.front().due <= Clock::now(); queue.pop_front()) {
      const std::vector<char>& bytes = queue.front().bytes;
      // A packet that the device does not take is one more lost packet.
      [[maybe_unused]] const ssize_t written = write(tun, bytes.data(), bytes.size());
    }
  }

 private:
  bool Loses(int side) {
    double share = loss_;
    if (burst_ > 0.0) {
      share = in_burst_[side] ? 1.0 - 1.0 / burst_ : loss_ / (burst_ * (1.0 - loss_));
    }
    return in_burst_[side] = std::uniform_real_distribution<>(0.0, 1.0)(random_) < share;
  }

  Clock::duration delay_ = {};
  double loss_ = 0.0;
  double burst_ = 0.0;
  bool in_burst_[2] = {};  // by direction: the last packet was lost
  bool is_cut_ = false;
  std::set<uint32_t> seen_;
  std::set<uint32_t> forgotten_;
  std::vector<char> buffer_;
  std::mt19937_64 random_{0};
};

// Reads what waits at the standard input and does the whole lines of it. Returns false at its end.
bool ReadOrders(Link& link, std::string& unread) {
  char bytes[4096];
  const ssize_t size = read(STDIN_FILENO, bytes, sizeof bytes);
  if (size <= 0) return false;
  unread.append(bytes, static_cast<size_t>(size));
  for (size_t end; (end = unread.find('\n')) != std::string::npos; unread.erase(0, end + 1)) {
    link.Do(unread.substr(0, end));
  }
  return true;
}

void Run(const int tuns[2]) {
  Link link;
  std::string unread;
  std::deque<Packet> queues[2];  // read from one device, for the other one
  while (true) {
    timespec wait = {};
    const bool has_packets = !queues[0].empty() || !queues[1].empty();
    Clock::time_point next = Clock::time_point::max();
    for (const auto& queue : queues) {
      if (!queue.empty()) next = std::min(next, queue.front().due);
    }
    if (has_packets) {
      const auto left = std::chrono::nanoseconds(next - Clock::now()).count();
      wait.tv_sec = std::max<int64_t>(left, 0) / 1'000'000'000;
      wait.tv_nsec = std::max<int64_t>(left, 0) % 1'000'000'000;
    }
    pollfd polled[] = {{tuns[0], POLLIN, 0}, {tuns[1], POLLIN, 0}, {STDIN_FILENO, POLLIN, 0}};
    ppoll(polled, 3, has_packets ? &wait : nullptr, nullptr);
    if (polled[2].revents != 0 && !ReadOrders(link, unread)) return;
    for (int side = 0; side < 2; ++side) {
      if (polled[side].revents != 0) link.Read(tuns[side], side, queues[side]);
      Link::Write(tuns[1 - side], queues[side]);
    }
  }
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 3) return 2;
  prctl(PR_SET_TIMERSLACK, 1UL);  // nanoseconds
  const int tuns[] = {OpenTun(argv[1]), OpenTun(argv[2])};
  std::cout << "ready" << std::endl;
  Run(tuns);
  return 0;
}
