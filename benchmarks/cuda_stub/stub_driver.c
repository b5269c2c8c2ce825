/* A libcuda.so without a GPU: answers what Taichi 1.7.4 asks the driver, keeps every PTX module, runs nothing.
 *
 * STUB_FOLDER   where NNNN.ptx and calls.tsv go (module, entry, blocks, threads of a launch; or the name of a wait)
 * STUB_CC       compute capability times 10 that it claims, default 90
 * Device memory is host memory, zeroed and taken page by page on demand, so copies work. */
#define _GNU_SOURCE
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

typedef int Result;
enum { SUCCESS = 0, OUT_OF_MEMORY = 2, NOT_SUPPORTED = 801, DEVICE_MEMORY = 2, POINTER_MEMORY_TYPE = 2 };

struct module { int number; };
struct function { struct module *module; char name[256]; };

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static FILE *calls;
static int n_module;
static __thread void *context;

static FILE *opened(const char *name) {
  const char *folder = getenv("STUB_FOLDER");
  char path[4096];
  snprintf(path, sizeof path, "%s/%s", folder ? folder : ".", name);
  return fopen(path, "w");
}

static void tell(const char *module, const char *name, unsigned blocks, unsigned threads) {
  pthread_mutex_lock(&lock);
  if (!calls) calls = opened("calls.tsv");
  if (calls) {
    fprintf(calls, "%s\t%s\t%u\t%u\n", module, name, blocks, threads);
    fflush(calls);
  }
  pthread_mutex_unlock(&lock);
}

static Result waits(const char *name) { tell("wait", name, 0, 0); return SUCCESS; }

/* ------------------------------------------------------------------------------------------------- the device */

Result cuInit(unsigned flags) { return SUCCESS; }
Result cuDriverGetVersion(int *v) { *v = 12080; return SUCCESS; }
Result cuDeviceGetCount(int *n) { *n = 1; return SUCCESS; }
Result cuDeviceGet(int *device, int ordinal) { *device = 0; return SUCCESS; }
Result cuDeviceGetName(char *name, int length, int device) { snprintf(name, length, "stub"); return SUCCESS; }
Result cuDeviceGetDefaultMemPool(void **pool, int device) { *pool = (void *)0x11; return SUCCESS; }
Result cuMemPoolSetAttribute(void *pool, int attribute, void *value) { return SUCCESS; }

Result cuDeviceGetAttribute(int *value, int attribute, int device) {
  const char *claimed = getenv("STUB_CC");
  int capability = claimed ? atoi(claimed) : 90;
  switch (attribute) {
    case 1: *value = 1024; break;     /* threads of a block */
    case 8: *value = 49152; break;    /* shared memory of a block [bytes] */
    case 10: *value = 32; break;      /* threads of a warp */
    case 12: *value = 65536; break;   /* registers of a block */
    case 13: *value = 1980000; break; /* clock [kHz] */
    case 16: *value = 132; break;     /* multiprocessors */
    case 39: *value = 2048; break;    /* threads of a multiprocessor */
    case 75: *value = capability / 10; break;
    case 76: *value = capability % 10; break;
    case 81: *value = 233472; break;  /* shared memory of a multiprocessor [bytes] */
    case 82: *value = 65536; break;   /* registers of a multiprocessor */
    case 97: *value = 232448; break;  /* shared memory of a block on request [bytes] */
    case 106: *value = 32; break;     /* blocks of a multiprocessor */
    default: *value = 1;
  }
  return SUCCESS;
}

Result cuCtxCreate_v2(void **c, unsigned flags, int device) { *c = context = (void *)0x22; return SUCCESS; }
Result cuDevicePrimaryCtxRetain(void **c, int device) { *c = (void *)0x22; return SUCCESS; }
Result cuCtxGetCurrent(void **c) { *c = context; return SUCCESS; }
Result cuCtxSetCurrent(void *c) { context = c; return SUCCESS; }
Result cuCtxSetLimit(int limit, size_t value) { return SUCCESS; }

/* ----------------------------------------------------------------------------------------------------- memory */

Result cuMemAlloc_v2(void **place, size_t n) {
  *place = mmap(0, n + 4096, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
  return *place == MAP_FAILED ? OUT_OF_MEMORY : SUCCESS;
}
Result cuMemAllocAsync(void **place, size_t n, void *stream) { return cuMemAlloc_v2(place, n); }
Result cuMemAllocManaged(void **place, size_t n, unsigned flags) { return cuMemAlloc_v2(place, n); }
Result cuMemFree_v2(void *place) { return SUCCESS; }
Result cuMemFreeAsync(void *place, void *stream) { return SUCCESS; }
Result cuMemGetInfo_v2(size_t *left, size_t *all) { *left = 78ull << 30; *all = 80ull << 30; return SUCCESS; }
Result cuMemAdvise(void *place, size_t n, int advice, int device) { return SUCCESS; }
Result cuMemcpyDtoD_v2(void *to, void *from, size_t n) { memmove(to, from, n); return SUCCESS; }
Result cuMemcpyDtoH_v2(void *to, void *from, size_t n) { memmove(to, from, n); return waits(__func__); }
Result cuMemcpyHtoD_v2(void *to, void *from, size_t n) { memmove(to, from, n); return waits(__func__); }
Result cuMemcpyDtoHAsync_v2(void *to, void *from, size_t n, void *stream) { memmove(to, from, n); return SUCCESS; }
Result cuMemcpyHtoDAsync_v2(void *to, void *from, size_t n, void *stream) { memmove(to, from, n); return SUCCESS; }
Result cuMemsetD8_v2(void *place, unsigned char value, size_t n) { if (value) memset(place, value, n); return SUCCESS; }
Result cuMemsetD32_v2(void *place, unsigned value, size_t n) {
  if (value) for (size_t i = 0; i < n; i++) ((unsigned *)place)[i] = value;
  return SUCCESS;
}
/* Every tensor is the device's: torch's would be, with a GPU. */
Result cuPointerGetAttribute(void *value, int attribute, void *place) {
  *(unsigned *)value = attribute == POINTER_MEMORY_TYPE ? DEVICE_MEMORY : 0;
  return SUCCESS;
}

/* -------------------------------------------------------------------------------------------- modules, launches */

Result cuModuleLoadDataEx(void **module, const char *ptx, unsigned n, void *options, void *values) {
  struct module *kept = malloc(sizeof *kept);
  pthread_mutex_lock(&lock);
  kept->number = n_module++;
  pthread_mutex_unlock(&lock);
  char name[32];
  snprintf(name, sizeof name, "%04d.ptx", kept->number);
  FILE *file = opened(name);
  if (!file) return OUT_OF_MEMORY;
  fputs(ptx, file);
  fclose(file);
  *module = kept;
  return SUCCESS;
}
Result cuModuleGetFunction(void **function, void *module, const char *name) {
  struct function *kept = malloc(sizeof *kept);
  kept->module = module;
  snprintf(kept->name, sizeof kept->name, "%s", name);
  *function = kept;
  return SUCCESS;
}
Result cuFuncGetAttribute(int *value, int attribute, void *function) { *value = 64; return SUCCESS; }
Result cuFuncSetAttribute(void *function, int attribute, int value) { return SUCCESS; }
Result cuOccupancyMaxActiveBlocksPerMultiprocessor(int *blocks, void *function, int threads, size_t shared) {
  *blocks = 8;
  return SUCCESS;
}
Result cuLaunchKernel(void *function, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by, unsigned bz,
                      unsigned shared, void *stream, void **arguments, void **extra) {
  struct function *launched = function;
  char module[32];
  snprintf(module, sizeof module, "%04d", launched->module->number);
  tell(module, launched->name, gx, bx);
  return SUCCESS;
}

Result cuStreamCreate(void **stream, unsigned flags) { *stream = (void *)0x33; return SUCCESS; }
Result cuStreamSynchronize(void *stream) { return waits(__func__); }
Result cuEventCreate(void **event, unsigned flags) { *event = (void *)0x44; return SUCCESS; }
Result cuEventDestroy(void *event) { return SUCCESS; }
Result cuEventRecord(void *event, void *stream) { return SUCCESS; }
Result cuEventSynchronize(void *event) { return waits(__func__); }
Result cuEventElapsedTime(float *ms, void *a, void *b) { *ms = 0; return SUCCESS; }
Result cuGetErrorName(int error, const char **text) { *text = error ? "STUB_ERROR" : "CUDA_SUCCESS"; return SUCCESS; }
Result cuGetErrorString(int error, const char **text) { *text = error ? "the stub cannot do that" : "no error"; return SUCCESS; }

#define MISSING(name) Result name(void) { return NOT_SUPPORTED; }
MISSING(cuExternalMemoryGetMappedBuffer)
MISSING(cuExternalMemoryGetMappedMipmappedArray)
MISSING(cuImportExternalMemory)
MISSING(cuImportExternalSemaphore)
MISSING(cuMipmappedArrayGetLevel)
MISSING(cuSignalExternalSemaphoresAsync)
MISSING(cuSurfObjectCreate)
MISSING(cuWaitExternalSemaphoresAsync)
