// A function of Lua that scripts of Redis begin with.
#pragma once

namespace spikeserve {

// keep_members(key, names, alive) keeps names, which end with a line each, in a sorted set by the
// time at which they were alive last. Members that were alive for the last time more than `alive`
// milliseconds ago are removed.
inline constexpr char kKeepMembers[] = R"(
local function keep_members(key, names, alive)
  local time = redis.call('TIME')
  local now = time[1] * 1000 + math.floor(time[2] / 1000)
  for name in string.gmatch(names, '[^\n]+') do redis.call('ZADD', key, now, name) end
  for _, name in ipairs(redis.call('ZRANGEBYSCORE', key, '(' .. now, '+inf')) do
    redis.call('ZADD', key, now, name)  -- the clock was set back
  end
  redis.call('ZREMRANGEBYSCORE', key, '-inf', now - alive)
  redis.call('PEXPIRE', key, alive)
end
)";

}  // namespace spikeserve
