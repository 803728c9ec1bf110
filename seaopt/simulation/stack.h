/* Work on a stack of its own where it needs more than a thread's may have: 8 MB as a rule, 512 kB elsewhere. */
#include <pthread.h>
#include <stddef.h>

#define ANY_STACK 262144 /* bytes that every thread has left; most plants need 20,000 to 200,000 */

static int on_own_stack(void *(*work)(void *), void *task, size_t bytes) {
    pthread_attr_t attributes;
    pthread_t thread;
    if (bytes <= ANY_STACK) {
        work(task);
        return 0;
    }
    if (pthread_attr_init(&attributes)) return 1;
    const int failed = pthread_attr_setstacksize(&attributes, (bytes | 0xffff) + 1) || pthread_create(&thread, &attributes, work, task);
    pthread_attr_destroy(&attributes);
    return failed || pthread_join(thread, 0);
}

