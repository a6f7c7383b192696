/* Models the requests of one stream for a session that moves between servers: those that arrive while the session is
 * being taken over wait in one line, and those behind them, too (docs/design/durability.md).
 *
 * The client sends its requests without waiting for answers. Another call may take the session over at any time, which
 * makes it visible to all; another server may, too, and a request that is ahead of this copy gives the copy up.
 *
 * Checked, by assertions:
 * - requests are decided in their order;
 * - a session that the store has is never answered with NOT_FOUND.
 *
 * Each of these is the old protocol, so that the check must fail:
 * -DVISIBLE_FIRST  a request that finds the session is decided although others wait
 * -DONE_CLAIM      a request that has waited and finds the session gone again is answered with NOT_FOUND
 *
 * run_model.py runs SPIN on this file. Behind each transition stands the function that implements it. */

#define REQUESTS 5
#define MOST_LEAVES 3

byte decided = 0;
bool here = false;      /* in the SessionStore of this server */
bool claiming = false;  /* for the first one that waits */
bool is_added = false;  /* SessionStore::Restore() was called, and OnClaimed() is posted */
byte released = 0;      /* of those that wait, how many the last claim was for */
byte leaves = 0;
bool is_over = false;   /* the client was told UNAVAILABLE, and begins again on another stream */

chan arrivals = [REQUESTS] of { byte };
chan line = [REQUESTS] of { byte };  /* ActQueue::waiting_ */

inline decide(k) {
  assert(k == decided);
  decided++
}

active proctype Client() {
  byte k = 0;
  do
  :: k < REQUESTS -> arrivals!k; k++
  :: else -> break
  od
}

/* The loop to which the session belongs. */
active proctype Queue() {
  byte k = 0;
  do
  /* ActQueue::HoldBack(), PolicyHandler::ActGroup(), ActQueue::Wait() */
#ifdef VISIBLE_FIRST
  :: atomic {
       !is_over && nempty(arrivals) ->
       arrivals?k;
       if
       :: here -> decide(k)
       :: else -> line!k; claiming = true
       fi;
       k = 0
     }
#else
  :: atomic {
       !is_over && nempty(arrivals) ->
       arrivals?k;
       if
       :: len(line) > 0 -> line!k
       :: len(line) == 0 && here -> decide(k)
       :: len(line) == 0 && !here -> line!k; claiming = true
       fi;
       k = 0
     }
#endif
  /* ActQueue::OnClaimed() */
  :: atomic { claiming && is_added -> claiming = false; is_added = false; released = len(line) }
  /* ActQueue::DecideWaiting() */
  :: atomic {
       !is_over && !claiming && nempty(line) ->
       if
       :: here -> line?k; decide(k); released = (released > 0 -> released - 1 : 0)
       :: !here && released > 0 ->
#ifdef ONE_CLAIM
         assert(false)
#else
         is_over = true  /* SessionGate::MovedError() */
#endif
       :: !here && released == 0 -> claiming = true
       fi;
       k = 0
     }
  od
}

/* SessionRecovery: the store has the session, so a claim succeeds. */
active proctype Recovery() {
  do
  :: atomic { claiming && !is_added -> here = true; is_added = true }
  :: atomic { !here && leaves < MOST_LEAVES -> here = true }  /* for a call of its own: EndEpisode, a batch */
  :: atomic { here && leaves < MOST_LEAVES -> leaves++; here = false }  /* SessionJournal::lost() */
  od
}
