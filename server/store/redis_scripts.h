// The scripts with which servers change the journals of sessions in Redis (redis_backend.h).
//
// The fields `base` and `changes` of the hash name the snapshot with which the list begins and how
// often the session had changed by then. Both begin with the epoch, without which a server of an
// older release has written the hash.
//
// Redis does not take back what a script has written when it refuses a later command. In a slot
// that a Cluster moves it refuses commands on keys that it does not have any more. Therefore
// nothing is removed before what replaces it is written, and a script that stops before any of its
// commands leaves the journal of before or the one of afterwards, which begins at its last snapshot
// (ParseJournal). All scripts name all of their keys, so that Redis refuses a script before its
// first command if one of them has moved. A first write that takes memory makes Redis whose memory
// is full refuse the whole script; one that takes none lets all of it run.
#pragma once

namespace spikeserve::redis_scripts {

// What the hash has, and whether the caller owns it: at its epoch, or at an older one if the store
// has gone back to what it was before the caller's last claim or move. ARGV: epoch, owner, epoch
// before the claim.
inline constexpr char kIsMine[] = R"(
local found = redis.call('HMGET', KEYS[1], 'epoch', 'owner', 'state', 'tenant')
local is_same = found[1] == ARGV[1] and (not found[2] or found[2] == ARGV[2] or found[2] == '')
local is_older = found[1] and tonumber(found[1]) < tonumber(ARGV[1]) and
                 (found[2] == ARGV[2] or found[1] == ARGV[3])
)";

// Writes a snapshot, which replaces all of a journal. Returns 1, the older epoch that it replaces,
// 0 if another owner has the session, or a newer copy of it, or -1 if another tenant has or had a
// session of this id. KEYS: hash, list, list of the epoch
// that it may replace, or the former again if the caller does not know of any. ARGV: as above,
// owner from now on, tenant, snapshot, retention in milliseconds, policy file, base, changes of the
// session, most changes of another owner's copy that it replaces, or nothing if it opens a session.
inline constexpr char kPut[] = R"(
if found[1] and found[4] and found[4] ~= ARGV[5] then return -1 end
if found[1] and not (found[3] == 'open' and (is_same or is_older and ARGV[11] ~= '')) then return 0 end
if is_older and found[2] ~= ARGV[2] then
  if KEYS[3] == KEYS[2] then return 0 end
  local changes = string.match(redis.call('HGET', KEYS[1], 'changes') or '', found[1] .. ':(%d+)') or 0
  if changes + math.max(redis.call('LLEN', KEYS[3]), 1) - 1 > tonumber(ARGV[11]) then return 0 end
end
redis.call('RPUSH', KEYS[2], ARGV[6])
redis.call('PEXPIRE', KEYS[2], ARGV[7])
redis.call('HSET', KEYS[1], 'epoch', ARGV[1], 'owner', ARGV[4], 'tenant', ARGV[5], 'state', 'open',
           'policy', ARGV[8], 'base', ARGV[9], 'changes', ARGV[1] .. ':' .. ARGV[10])
redis.call('PEXPIRE', KEYS[1], ARGV[7])
redis.call('LTRIM', KEYS[2], -1, -1)
if is_older and KEYS[3] ~= KEYS[2] then redis.call('DEL', KEYS[3]) end
return is_older and found[1] or 1)";

// Ends a journal and leaves a tombstone, also when the memory is full. Returns as kPut.
// KEYS: hash, list. ARGV: as for kIsMine, milliseconds of the tombstone.
inline constexpr char kClose[] = R"(
if found[1] and not (is_same or is_older) then return 0 end
redis.call('HDEL', KEYS[1], '')
redis.call('HSET', KEYS[1], 'epoch', ARGV[1], 'state', 'closed')
redis.call('PEXPIRE', KEYS[1], ARGV[4])
redis.call('HDEL', KEYS[1], 'owner', 'policy', 'base', 'changes', found[4] == '' and 'tenant' or '')
redis.call('DEL', KEYS[2])
return is_older and found[1] or 1)";

// Makes the caller the owner. Returns the journal, nothing if there is none, or 0 if the session
// has another epoch by now. KEYS: hash, list, list of the new epoch. ARGV: epoch, new epoch, owner,
// retention in milliseconds.
inline constexpr char kClaim[] = R"(
local found = redis.call('HMGET', KEYS[1], 'epoch', 'state', 'changes')
if found[1] ~= ARGV[1] or found[2] ~= 'open' then return 0 end
local records = redis.call('LRANGE', KEYS[2], 0, -1)
if #records == 0 then return false end
local changes = string.match(found[3] or '', ARGV[1] .. ':(%d+)') or ''
redis.call('DEL', KEYS[3])
redis.call('RPUSH', KEYS[3], unpack(records))
redis.call('PEXPIRE', KEYS[3], ARGV[4])
redis.call('HSET', KEYS[1], 'epoch', ARGV[2], 'owner', ARGV[3], 'base', ARGV[2] .. ':0',
           'changes', ARGV[2] .. ':' .. changes)
redis.call('PEXPIRE', KEYS[1], ARGV[4])
redis.call('DEL', KEYS[2])
return records)";

// Moves the journal of the caller to another epoch, without the records after the first ones, which
// were sent and not acknowledged. Returns 1 if that was done, now or before, or if the store does
// not have the journal, and 0 if another owner has the session. KEYS: as for kClaim. ARGV: epoch,
// new epoch, owner, number of records to keep or 0 for all.
inline constexpr char kMove[] = R"(
local found = redis.call('HMGET', KEYS[1], 'epoch', 'owner', 'state', 'base', 'changes')
if not found[1] or found[1] == ARGV[2] then return 1 end
if tonumber(found[1]) < tonumber(ARGV[1]) then return 1 end
if found[1] ~= ARGV[1] or found[2] ~= ARGV[3] or found[3] ~= 'open' then return 0 end
local records = redis.call('LRANGE', KEYS[2], 0, ARGV[4] - 1)
if #records == 0 then return 1 end
redis.call('DEL', KEYS[3])
redis.call('RPUSH', KEYS[3], unpack(records))
local expiry = redis.call('PTTL', KEYS[2])
if expiry > 0 then redis.call('PEXPIRE', KEYS[3], expiry) end
redis.call('HSET', KEYS[1], 'epoch', ARGV[2],
           'base', ARGV[2] .. ':' .. string.match(found[4] or '', '%d*$'),
           'changes', ARGV[2] .. ':' .. string.match(found[5] or '', '%d*$'))
redis.call('DEL', KEYS[2])
return 1)";

// Compares a journal, and sets its expiry. Returns 1 if it is as expected, and 0 otherwise.
// KEYS: hash, list. ARGV: epoch, owner, base, number of records, retention in milliseconds or
// nothing.
inline constexpr char kCheck[] = R"(
local found = redis.call('HMGET', KEYS[1], 'epoch', 'owner', 'base')
if found[1] ~= ARGV[1] or found[2] ~= ARGV[2] or found[3] ~= ARGV[3] or
   redis.call('LLEN', KEYS[2]) ~= tonumber(ARGV[4]) then return 0 end
if ARGV[5] ~= '' then
  redis.call('PEXPIRE', KEYS[1], ARGV[5])
  redis.call('PEXPIRE', KEYS[2], ARGV[5])
end
return 1)";

}  // namespace spikeserve::redis_scripts
