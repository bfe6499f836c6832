/* A producer that never gets beyond its first call: it hangs there, or it crashes. */
#include <signal.h>
#include <unistd.h>

int GCInitLib(void) {
#ifdef CRASHES
  raise(SIGSEGV);
#endif
  for (;;) pause();
}
